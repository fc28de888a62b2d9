"""What a plant declares about its uncertainty, proved or refuted over the operating region and the admissible theta.

`derive_bounds` finds bounds that hold, `check_bounds` proves the declared ones or gives a counterexample. Admissible are the
theta of the declared box with abs(Delta_3) <= delta_3; [1] needs delta_3 < 1.

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output time-derivatives
    to compensate unmatched uncertainties.
"""

from collections.abc import Mapping
from itertools import islice, product
from math import inf

import numpy as np
import sympy as sp

from mfc_gym.branch_and_bound import BUDGET, Box, Point, Verdict, enclose, prove_bound
from mfc_gym.domain import undefined_at, zero_at
from mfc_gym.falsification import Counterexample, falsify
from mfc_gym.flat_system import BOUNDS, FlatSystem
from mfc_gym.interval_function import IntervalFunction
from mfc_gym.termwise import proves
from mfc_gym.triangle import round_up, triangle_bound
from mfc_gym.uncertainty import Uncertainty, region_box

__all__ = [
    "Box",
    "Counterexample",
    "Verdict",
    "check_bounds",
    "check_domain",
    "derive_bounds",
    "enclose",
    "falsify",
    "prove_bound",
    "region_box",
]
TOLERANCE = 1e-9  # of a declared bound, relative above 1: what the rounding of its decimals may cost


def check_domain(system: FlatSystem) -> None:
    """Raises ValueError where an expression of the system is not defined, or beta vanishes, within region and theta box."""
    u = Uncertainty(system)
    for name in ("f", "g", "Delta"):
        for i, entry in enumerate(getattr(system, name), start=1):
            if clause := undefined_at([entry], u.box):
                raise ValueError(f"`{name}` entry {i} must be defined in the whole operating region: {clause}.")
    if clause := undefined_at([system.h], u.box):
        raise ValueError(f"`h` must be defined in the whole operating region: {clause}.")
    message = "`f`, `g`, `h` and `Delta` must have derivatives in the whole operating region"
    if clause := undefined_at([*system.lie_f, system.beta], u.box):
        raise ValueError(f"{message}: {clause}.")
    if clause := zero_at(system.beta, u.region):
        raise ValueError(f"`g` must give an input gain L_g L_f^(n-1) h other than zero in the whole region: {clause}.")
    if clause := undefined_at([*system.lie_f_Delta, u.Delta_3], u.box):
        raise ValueError(f"{message}: {clause}.")


def derive_bounds(system: FlatSystem) -> dict[str, sp.Expr]:
    """All bounds of `mfc_gym.nominal`: the declared ones, the others rigorously from the equations and the sets.

    Where theta can be separated from the state they are functions of the state (triangle inequality), else constants.
    Raises ValueError if abs(Delta_3) reaches 1 in the theta box and no delta_3 is declared that says which theta count.
    """
    u = Uncertainty(system)
    u.require_theta()
    bounds = dict(system.bounds)
    for name in BOUNDS:
        if name not in bounds:
            bounds[name] = _derived(u, name, bounds)
    return {name: bounds[name] for name in BOUNDS}


def _derived(u: Uncertainty, name: str, known: Mapping[str, sp.Expr]) -> sp.Expr:
    numerator, denominator = u.quotient(name)
    if name == "delta_3":
        bound = triangle_bound(numerator, u.theta)
        if bound is not None and enclose(bound, u.region, budget=BUDGET // 10)[1] < 1:
            return bound
        return _finite(name, u.range_3)
    if denominator == 1:
        return bound_of(u, name, numerator)
    bound = triangle_bound(numerator, u.theta, denominator) if u.uniform else None
    return known[f"delta_{name[-1]}"] / u.least_gain(known["delta_3"]) if bound is None else bound


def bound_of(u: Uncertainty, name: str, expression: sp.Expr) -> sp.Expr:
    """Bound of abs(expression), function of the state or constant; ValueError about `name` if there is none."""
    bound = triangle_bound(expression, u.theta)
    if bound is not None:
        return bound
    return _finite(name, enclose(expression, u.box, where=u.where, tolerance=0.01, budget=BUDGET // 4))


def sharp_bound_of(u: Uncertainty, name: str, expression: sp.Expr, delta_3: sp.Expr) -> sp.Expr:
    """The same of abs(expression) / (1 + Delta_3)."""
    bound = triangle_bound(expression, u.theta, 1 + u.Delta_3) if u.uniform else None
    return bound_of(u, name, expression) / u.least_gain(delta_3) if bound is None else bound


def _finite(name: str, ends: tuple[float, float]) -> sp.Expr:
    low, high = ends
    if not max(-low, high) < inf:
        raise ValueError(f"`bounds` must give {name}: what it bounds could not be enclosed over region and theta.")
    return round_up(max(-low, high))


def check_bounds(
    system: FlatSystem, *, rng: np.random.Generator | None = None, budget: int = BUDGET
) -> dict[str, Verdict]:
    """The verdict on every declared bound, "proved" or "undecided" (no counterexample found).

    Raises ValueError with a counterexample if a bound does not hold, if delta_3 may reach 1, or if no theta is admissible;
    without a declared delta_3 if abs(Delta_3) reaches 1 in the theta box.
    """
    u = Uncertainty(system)
    rng = np.random.default_rng(0) if rng is None else rng
    u.require_theta()
    if u.delta_3 is not None:
        below_one = prove_bound(u.delta_3, 1, u.region, strict=True)
        if below_one.status != "proved":
            raise ValueError(f"`bounds` must have delta_3 < 1 in the whole region, got {u.delta_3}.")
        _check_default_theta(u)
    return {name: _verdict(u, name, bound, rng, budget) for name, bound in system.bounds.items()}


def _check_default_theta(u: Uncertainty) -> None:
    task = u.system.task
    theta = task.theta or [(low + high) / 2 for low, high in u.theta_box.values()]
    at_default = {s: sp.Rational(value) for s, value in zip(u.theta_box, theta, strict=True)}
    verdict = _two_sided(u.Delta_3.subs(at_default), u.delta_3, u.region, [], 20_000)
    if verdict.status == "refuted":
        raise ValueError(f"`theta` of the task must keep abs(Delta_3) <= delta_3 = {u.delta_3}, got {tuple(theta)}.")


def _verdict(u: Uncertainty, name: str, bound: sp.Expr, rng: np.random.Generator, budget: int) -> Verdict:
    if name == "delta_3" and u.is_gate:
        return Verdict("proved", 0.0)  # it is what makes a theta admissible
    numerator, denominator = u.quotient(name)
    tolerance = TOLERANCE * max(1.0, _attained(bound, u.region))
    verdict = _separate_verdict(u, name, bound, budget, tolerance)
    if verdict is not None:
        return verdict
    found = falsify(
        sp.Abs(numerator, evaluate=False), bound * denominator, u.box, rng, where=u.where, tolerance=tolerance
    )
    if found is not None:
        raise ValueError(_refusal(name, numerator / denominator, bound, found.point))
    verdict = _two_sided(numerator, bound * denominator, u.box, u.where, budget, tolerance)
    if verdict.status == "refuted" and verdict.point is not None:
        raise ValueError(_refusal(name, numerator / denominator, bound, verdict.point))
    return verdict


def _attained(bound: sp.Expr, region: Box) -> float:
    """A value that the bound is known to take: the largest at the corners of the region (up to 64) and its centre."""
    function = IntervalFunction([bound], list(region))
    corners = islice(product(*region.values()), 64)
    points = [*corners, [(low + high) / 2 for low, high in region.values()]]
    values = (function([(p, p) for p in point])[0] for point in points)
    return max((low for low, high in values if high < inf), default=1.0)


def _separate_verdict(u: Uncertainty, name: str, bound: sp.Expr, budget: int, tolerance: float) -> Verdict | None:
    """Proof after theta has been separated from the state, None if there is none."""
    numerator, denominator = u.quotient(name)
    if denominator != 1 and not u.uniform:
        gain = u.least_gain(u.delta_3 if u.delta_3 is not None else sp.S.One)
        bound, denominator = bound * gain, sp.S.One
    if proves(bound, numerator, denominator, u.region, u.theta, TOLERANCE):
        return Verdict("proved", 0.0)
    triangle = triangle_bound(numerator, u.theta, denominator)
    if triangle is None:
        return None
    verdict = prove_bound(triangle, bound, u.region, tolerance=tolerance, budget=budget // 4)
    return verdict if verdict.status == "proved" else None


def _two_sided(
    expr: sp.Expr, bound: sp.Expr, box: Box, where: list[sp.Expr], budget: int, tolerance: float = TOLERANCE
) -> Verdict:
    """abs(expr) <= bound, each sign by itself: both are as smooth as expr."""
    verdicts = [
        prove_bound(sign * expr, bound, box, where=where, tolerance=tolerance, budget=budget) for sign in (1, -1)
    ]
    rank = {"proved": 0, "undecided": 1, "refuted": 2}
    return max(verdicts, key=lambda v: (rank[v.status], v.excess))


def _refusal(name: str, expr: sp.Expr, bound: sp.Expr, point: Point) -> str:
    meaning = {"delta_1": "Delta_1", "delta_3": "Delta_3", "delta_m": "phi_m"}.get(
        name, f"Delta_{name[-1]} / (1 + Delta_3)"
    )
    value, limit = (float(abs(e.subs(point))) for e in (expr, bound))
    where = ", ".join(f"{s} = {v:.6g}" for s, v in sorted(point.items(), key=lambda item: item[0].name))
    return f"`bounds` {name} must bound abs({meaning}): {value:.6g} exceeds {limit:.6g} at {where}."
