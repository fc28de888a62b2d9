"""The gain rules against the theorem: V' <= -W for every admissible uncertainty, and how much gain that takes."""

from typing import Any

import numpy as np
import pytest

from baselines import gains, lyapunov
from baselines.lyapunov import Array

EPS = float(np.finfo(float).eps)
RHO = 0.25
SAMPLES = 100_000
RULES = ("paper", "theorem", "sharp")
BOUNDS = {  # of the perturbed chain, Section 6 of [1]: abs(Delta_1) = p abs(x)^2, abs(Delta_3) = abs(p - 1) <= rho
    "delta_1": lambda norm2: (1 + RHO) * norm2,
    "delta_3": lambda norm2: np.full_like(norm2, RHO),
    "delta_m": lambda norm2: norm2,
    "sharp_1": lambda norm2: norm2,
    "sharp_3": lambda norm2: np.full_like(norm2, RHO / (1 - RHO)),
}


def rule(name: str) -> Any:
    """The rule on arrays: the function that is compiled, plain arithmetic."""
    return gains.GAINS[name].rule.py_func  # type: ignore[attr-defined]


class Samples:
    """States, model errors, references and admissible theta of the chain at random, and the terms of the proof."""

    def __init__(self, n: int, matched: bool = False) -> None:
        rng = np.random.default_rng(n)
        x = rng.uniform(-3, 3, (SAMPLES, n))
        theta = rng.uniform(-0.5, 0.5, (SAMPLES, n - 1))
        # p = prod(1 + theta) is set to its drawn value within the bound by the last theta; both ends belong to it
        p = rng.uniform(1 - RHO, 1 + RHO, SAMPLES)
        p[: SAMPLES // 4], p[SAMPLES // 4 : SAMPLES // 2] = 1 - RHO, 1 + RHO
        theta[:, -1] = p / np.prod(1 + theta[:, :-1], axis=1) - 1
        if matched:
            theta[:], p[:] = 0, 1
        xi_n = x * np.cumprod(np.column_stack([np.ones(SAMPLES), 1 + theta]), axis=1)
        k, k_tilde = lyapunov.place([-1.0] * n), lyapunov.place([-4.0] * n)
        reference, e_star = rng.uniform(-2, 2, (SAMPLES, n + 1)), rng.uniform(-2, 2, (SAMPLES, n))
        e = xi_n - reference[:, :-1] - e_star
        P = lyapunov.from_Q(k_tilde)
        Q = lyapunov.dissipation(P, k_tilde)  # the identity up to the error of P
        self.norm2 = (x**2).sum(axis=1)
        self.bounds = tuple(bound(self.norm2) for bound in BOUNDS.values())
        self.omega_star, self.v_tilde = reference[:, -1] - e_star @ k, -e @ k_tilde
        self.Delta_1, self.Delta_3 = p * self.norm2, p - 1
        self.w = 2 * e @ lyapunov.surface(P)
        self.e, self.P, self.W = e, P, (e @ Q * e).sum(axis=1)

    def gain(self, name: str, factor: float = 1.0) -> Array:
        return factor * rule(name)(0.0, self.omega_star, self.v_tilde, self.bounds)

    def excess(self, Gamma: Array) -> tuple[Array, Array]:
        """V' + W with V' = 2 e' P (A e + B (y^(n) - omega_star)) along the true closed loop, and its rounding error."""
        u = self.omega_star + self.v_tilde - Gamma * np.sign(self.w)
        e_dot = np.column_stack([self.e[:, 1:], self.Delta_1 + (1 + self.Delta_3) * u - self.omega_star])
        large = self.Delta_1 + 2 * (np.abs(self.omega_star) + np.abs(self.v_tilde) + Gamma)
        terms = 2 * np.column_stack([np.abs(self.e[:, 1:]), large]) @ np.abs(self.P) * np.abs(self.e)
        return 2 * (e_dot @ self.P * self.e).sum(axis=1) + self.W, 20 * EPS * (terms.sum(axis=1) + self.W)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_every_rule_makes_the_lyapunov_function_decrease(n: int) -> None:
    """V' <= -W, the theorem of [1]. Rounding: sums of n^2 <= 16 terms, 20 eps of the sum of their absolute values."""
    samples = Samples(n)
    for name in RULES:
        excess, rounding = samples.excess(samples.gain(name))
        assert (excess <= rounding).all(), name


@pytest.mark.parametrize("n", [2, 3, 4])
def test_the_sharp_rule_is_sharp(n: int) -> None:
    """At p = 1 - rho, with all uncertainty pushing outwards, V' = -W exactly; 0.9 Gamma violates."""
    samples = Samples(n)
    against = (samples.Delta_3 == samples.Delta_3.min()) & (samples.w > 0) & (samples.omega_star + samples.v_tilde < 0)
    assert against.sum() > 1000
    excess, rounding = samples.excess(samples.gain("sharp"))
    assert (np.abs(excess[against]) <= rounding[against]).all()
    excess, rounding = samples.excess(samples.gain("sharp", 0.9))
    missing = 0.1 * (1 - RHO) * np.abs(samples.w) * samples.gain("sharp")  # (1 + Delta_3) abs(w) times what Gamma lacks
    assert (np.abs(excess - missing)[against] <= 2 * rounding[against]).all()
    assert (excess > rounding)[against].mean() > 0.99


@pytest.mark.parametrize("n", [2, 3, 4])
def test_the_matched_rule_suffices_for_matched_uncertainty_only(n: int) -> None:
    samples = Samples(n, matched=True)
    excess, rounding = samples.excess(samples.gain("matched"))
    assert (excess <= rounding).all()
    samples = Samples(n)
    excess, rounding = samples.excess(samples.gain("matched"))
    assert (excess > rounding).any()


@pytest.mark.parametrize("n", [2, 3, 4])
def test_rules_are_ordered(n: int) -> None:
    """sharp <= theorem <= paper; the second bit by bit, since rounding is monotone, the first up to a few roundings."""
    samples = Samples(n)
    sharp, theorem, paper = (samples.gain(name) for name in ("sharp", "theorem", "paper"))
    assert (sharp <= theorem * (1 + 8 * EPS)).all()
    assert (theorem <= paper).all()
    assert (sharp < theorem).mean() > 0.99
    assert (theorem < paper).mean() > 0.3  # wherever omega_star and v_tilde are of opposite sign


def test_rules_with_any_nominal_model() -> None:
    """w (v_L + Delta_1 + Delta_3 (-alpha + omega_star + v_tilde + v_L)) <= 0 for abs(Delta_i) <= delta_i, any alpha.

    Rounding: a few errors of each term.
    """
    rng = np.random.default_rng(0)
    alpha, omega_star, v_tilde = rng.normal(size=(3, SAMPLES)) * 10 ** rng.uniform(-2, 2, (3, SAMPLES))
    delta_1, delta_3 = rng.exponential(size=SAMPLES), rng.uniform(0, 0.99, SAMPLES)
    bounds = (delta_1, delta_3, delta_1, delta_1 / (1 - delta_3), delta_3 / (1 - delta_3))
    ends = rng.choice([-1.0, 1.0], (2, SAMPLES))
    inside = rng.uniform(-1, 1, (2, SAMPLES))
    for part in (ends, inside):
        Delta_1, Delta_3 = part[0] * delta_1, part[1] * delta_3
        for sign in (-1, 1):
            for name in RULES:
                Gamma = rule(name)(alpha, omega_star, v_tilde, bounds)
                v_L = -sign * Gamma
                power = sign * (v_L + Delta_1 + Delta_3 * (-alpha + omega_star + v_tilde + v_L))
                scale = Gamma + delta_1 + np.abs(alpha) + np.abs(omega_star) + np.abs(v_tilde)
                assert (power <= 20 * EPS * scale / (1 - delta_3)).all(), name


def test_without_input_uncertainty_all_rules_are_the_bound_of_the_matched_one() -> None:
    """delta_3 = 0: Gamma = delta_1, the special case of matched uncertainty in Section 5 of [1]."""
    bounds = (2.5, 0.0, 2.5, 2.5, 0.0)
    for name, (function, _) in gains.GAINS.items():
        assert function(3.0, -7.0, 11.0, bounds) == 2.5, name


def test_first_gains_of_the_example() -> None:
    """x = (1, 0, 0), omega_star = 3/2, v_tilde = -32: Gamma = 77/6, 71/6, and 1 + 30.5 / 3 with the true input gain."""
    bounds = (1.25, 0.25, 1.0, 1.0, 0.25 / 0.75)
    for name, Gamma in {"paper": 77 / 6, "theorem": 71 / 6, "sharp": 1 + 30.5 / 3, "matched": 1.0}.items():
        assert gains.GAINS[name].rule(0.0, 1.5, -32.0, bounds) == pytest.approx(Gamma, rel=4 * EPS)


def test_only_the_sharp_rule_has_a_margin() -> None:
    """The others exceed what is needed; the sharp one is the edge itself, where a sliding mode may end at any time."""
    assert gains.GAINS["sharp"].margin > 1
    assert {gains.GAINS[name].margin for name in gains.GAINS if name != "sharp"} == {1.0}
