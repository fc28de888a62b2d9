"""Rules for the switching gain Gamma_n: how much discontinuous control the bounds ask for.

bounds = (delta_1, delta_3, delta_m, sharp_1, sharp_3), see `mfc_gym.nominal`; alpha = L_f^n h.
"""

from collections.abc import Callable
from typing import NamedTuple

from numba import njit

Bounds = tuple[float, float, float, float, float]


@njit
def paper(alpha: float, omega_star: float, v_tilde: float, bounds: Bounds) -> float:
    """The example's rule in Section 6 of [1], the control's parts bounded one by one: sufficient and the largest."""
    return (bounds[0] + bounds[1] * (abs(omega_star - alpha) + abs(v_tilde))) / (1.0 - bounds[1])


@njit
def theorem(alpha: float, omega_star: float, v_tilde: float, bounds: Bounds) -> float:
    """Eq. (27) of [1]."""
    return (bounds[0] + bounds[1] * abs(omega_star - alpha + v_tilde)) / (1.0 - bounds[1])


@njit
def sharp(alpha: float, omega_star: float, v_tilde: float, bounds: Bounds) -> float:
    """abs(Delta_1 / (1 + Delta_3)) + abs(Delta_3 / (1 + Delta_3)) abs(...), each bounded: the smallest that suffices.

    From w (1 + Delta_3) v_L = -(1 + Delta_3) Gamma abs(w), the true input gain that the theorem estimates by 1 - delta_3.
    """
    return bounds[3] + bounds[4] * abs(omega_star - alpha + v_tilde)


@njit
def matched(alpha: float, omega_star: float, v_tilde: float, bounds: Bounds) -> float:
    """The bound of the matched uncertainty alone, eq. (24) of [1]."""
    return bounds[2]


class GainRule(NamedTuple):
    """A rule and the factor it is multiplied with by default."""

    rule: Callable[[float, float, float, Bounds], float]
    margin: float


GAINS = {
    "paper": GainRule(paper, 1.0),
    "theorem": GainRule(theorem, 1.0),
    "sharp": GainRule(sharp, 1.05),  # with no margin the sliding mode exists only on the edge of its condition
    "matched": GainRule(matched, 1.0),
}
