"""Search for a point that breaks a bound: Sobol sampling, then local refinement; a find is confirmed rigorously."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import sympy as sp
from scipy.stats import qmc

from mfc_gym.branch_and_bound import Box, Point
from mfc_gym.interval_function import IntervalFunction


@dataclass(frozen=True)
class Counterexample:
    """A point of the box with expr - bound >= excess > 0, proved in interval arithmetic."""

    point: Point
    excess: float


def falsify(
    expr: sp.Expr,
    bound: sp.Expr | float,
    box: Box,
    rng: np.random.Generator,
    *,
    where: Sequence[sp.Expr] = (),
    tolerance: float = 0.0,
    samples: int = 4096,
    rounds: int = 30,
) -> Counterexample | None:
    """A point of `box` where every expression of `where` is <= 0 and expr > bound + tolerance, or None if none was found."""
    expressions = [sp.sympify(expr) - sp.sympify(bound), *where]
    symbols = sorted(set().union(*(e.free_symbols for e in expressions)), key=lambda s: s.name)
    low, high = np.array([[float(end) for end in box[s]] for s in symbols]).reshape(-1, 2).T
    compiled = sp.lambdify(symbols, expressions, "numpy", dummify=True, cse=True)

    def excess(p: np.ndarray) -> np.ndarray:
        """expr - bound at the points p, shape (m, k); -inf where a `where` is positive or a value is not real."""
        with np.errstate(all="ignore"):
            value, *constraints = (np.broadcast_to(v, len(p)).astype(float) for v in compiled(*p.T))
        admissible = np.all([c <= 0 for c in constraints], axis=0) & np.isfinite(value)
        return np.where(admissible, value, -np.inf)

    points = low + (high - low) * _sobol(len(symbols), samples, rng)
    best = points[np.argsort(-excess(points), kind="stable")[:8]]
    radius = 0.1 * (high - low)
    for _ in range(rounds if symbols else 0):
        # each of the best points together with 32 neighbours, drawn closer and closer
        neighbours = best[:, None] + radius * rng.standard_normal((len(best), 32, len(symbols)))
        cloud = np.clip(np.concatenate([best[:, None], neighbours], axis=1), low, high)
        value = excess(cloud.reshape(-1, len(symbols))).reshape(len(best), -1)
        best = cloud[np.arange(len(best)), value.argmax(axis=1)]
        radius = radius * 0.7
    for p in best[np.argsort(-excess(best))]:
        (value_low, _), *constraints = IntervalFunction(expressions, symbols)([(v, v) for v in p])
        if value_low > tolerance and all(c <= 0 for _, c in constraints):
            return Counterexample(dict(zip(symbols, p.tolist(), strict=True)), value_low)
    return None


def _sobol(dimension: int, samples: int, rng: np.random.Generator) -> np.ndarray:
    """Scrambled Sobol points in the unit cube, the corners of the cube (up to 2^10 of them) added."""
    corners = np.array(list(product((0.0, 1.0), repeat=min(dimension, 10))))
    corners = np.concatenate([corners, rng.integers(0, 2, (len(corners), dimension - corners.shape[1]))], axis=1)
    if dimension == 0:
        return corners
    sampler = qmc.Sobol(dimension, scramble=True, seed=rng)
    return np.concatenate([corners, sampler.random_base2(int(np.ceil(np.log2(samples))))])
