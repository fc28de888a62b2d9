"""Variations of plants: what they keep, and that their bounds hold."""

from functools import cache

import numpy as np
import pytest
import sympy as sp

from mfc_gym.enclosure import check_bounds, falsify
from mfc_gym.flat_system import FlatSystem, is_zero
from mfc_gym.plant import build_system
from mfc_gym.uncertainty import Uncertainty
from mfc_gym.varying import disturbed, moving, turned

PLANTS = ("PerturbedChain", "FlexibleJoint", "Rossler", "VanDerPol")  # g constant, in several rows of Delta_u; y = x2


@cache
def plant(name: str) -> FlatSystem:
    return build_system(name, {})


def norm2(vector: tuple[sp.Expr, ...]) -> sp.Expr:
    return sp.Add(*(e**2 for e in vector))


def along(system: FlatSystem, vector: tuple[sp.Expr, ...]) -> sp.Expr:
    return sp.Add(*(a * b for a, b in zip(system.g, vector, strict=True)))


@pytest.mark.parametrize("name", PLANTS)
def test_turning_keeps_the_size(name: str) -> None:
    """What is added to Delta_m has the size of Delta_u for every unmatchedness, and its share s of the square is unmatched."""
    original = plant(name)
    matched, unmatched = original.decomposition
    for s in (0.0, 0.25, 1.0):
        varied = turned(original, s)
        change = tuple(a - b for a, b in zip(varied.Delta, matched, strict=True))
        assert is_zero(norm2(change) - norm2(unmatched))
        assert is_zero(norm2(varied.decomposition[1]) - sp.nsimplify(s) * norm2(unmatched))


@pytest.mark.parametrize("name", PLANTS)
def test_turned_altogether_it_is_matched(name: str) -> None:
    """Theorem 1 of [1]: Delta_u = 0, hence phi_u = 0, tau_n = tau, Delta_3 = 0."""
    varied = turned(plant(name), 0.0)
    assert all(is_zero(e) for e in varied.phi_u)
    assert all(is_zero(a - b) for a, b in zip(varied.tau_n, varied.tau, strict=True))
    assert is_zero(varied.Delta_3)
    assert varied.bounds["delta_3"] == 0


def test_the_same_theta_are_admissible_however_it_is_turned() -> None:
    for s in (0.0, 0.5):
        u = Uncertainty(turned(plant("PerturbedChain"), s))
        assert u.gate_3 == plant("PerturbedChain").Delta_3
        assert u.limit_3 == 0.25


VARIED = {
    "turned": lambda system: turned(system, 0.3),
    "matched": lambda system: turned(system, 0.0),
    "moving": lambda system: moving(system, next(iter(system.theta)), (0.2, 0.3, 0.4, 0.5)),
    "disturbed input": lambda system: disturbed(system, "u", (0.5, 0.4, 0.3, 0.2)),
    "disturbed row": lambda system: disturbed(system, system.state[1], (0.5, 0.4, 0.3, 0.2)),
}


@pytest.mark.parametrize("kind", VARIED)
@pytest.mark.parametrize("name", ["PerturbedChain", "VanDerPol"])
def test_bounds_hold(name: str, kind: str) -> None:
    """No bound is refuted, by branch and bound or by search."""
    verdicts = check_bounds(VARIED[kind](plant(name)), budget=5000)
    assert {verdict.status for verdict in verdicts.values()} <= {"proved", "undecided"}


def test_a_bound_too_small_is_found() -> None:
    """The search that the test above trusts: 0.9 times the bound is refuted."""
    varied = VARIED["disturbed row"](plant("PerturbedChain"))
    u = Uncertainty(varied)
    bound = sp.Rational(9, 10) * varied.bounds["delta_1"]
    assert falsify(sp.Abs(varied.Delta_1), bound, u.box, np.random.default_rng(0), where=u.where) is not None


def test_moving_theta_enter_the_derivatives() -> None:
    """y' = (1 + alpha1) x2, hence y'' = alpha1' x2 + (1 + alpha1) (1 + alpha2) x3."""
    varied = moving(plant("PerturbedChain"), "alpha1", (1.0, 1.0))
    x2, x3, a, b, rate = sp.symbols("x2 x3 alpha1 alpha2 alpha1_t1", real=True)
    assert is_zero(varied.tau_n[2] - (rate * x2 + (1 + a) * (1 + b) * x3))


def test_disturbances_enter_the_derivatives() -> None:
    """x1' = (1 + alpha1) x2 + d: y' has d, y'' has d'."""
    varied = disturbed(plant("PerturbedChain"), "x1", (1.0, 1.0, 1.0))
    d, rate = sp.symbols("d_x1 d_x1_t1", real=True)
    assert varied.tau_n[1].coeff(d) == 1
    assert varied.tau_n[2].coeff(rate) == 1


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        (lambda s: turned(s, 1.5), r"`unmatchedness` must lie in \[0, 1\], got 1.5"),
        (lambda s: moving(s, "beta", (1.0,)), r"`schedule` must be of \['alpha1', 'alpha2'\], got 'beta'"),
        (lambda s: disturbed(s, "y", (1.0,) * 3), r"`disturbance` must enter through 'u' or one of .* got 'y'"),
    ],
)
def test_errors(vary: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vary(plant("PerturbedChain"))


def test_a_plant_that_declares_no_sharp_bounds_can_be_varied() -> None:
    """They follow from delta_1 and delta_3 of the varied plant."""
    system = build_system("Rossler", {})
    assert "sharp_3" not in system.bounds
    for varied in (disturbed(system, "u", [0.1, 0.2, 0.4]), moving(system, "eps_a", [0.1, 0.2])):
        assert set(varied.bounds) == set(system.bounds)
        check_bounds(varied)
