"""The discontinuous control v_L = -Gamma sgn(w) in sampled time: laws for the set-valued sign.

All take (s, a, b, d, Gamma, width): s = w / 2 now; a the predicted next s with v_L = 0 and b > 0 its gain to v_L, so that
s_next = a + b v_L in the nominal model; d the disturbance estimate in units of v_L; `width` of a boundary layer, unit of s.

With p = 1 + Delta_3 the true input gain over the nominal one, in linear analysis of s_next:
"""

from collections.abc import Callable
from typing import NamedTuple

from numba import njit

Law = Callable[[float, float, float, float, float, float], float]


@njit
def clip(value: float, limit: float) -> float:
    """Projection to [-limit, limit]."""
    return min(max(value, -limit), limit)


@njit
def sign(s: float, a: float, b: float, d: float, Gamma: float, width: float) -> float:
    """Explicit sign, eq. (22) of [1] evaluated at the sample; sgn(0) = 0. Chatters with amplitude O(dt)."""
    if s > 0.0:
        return -Gamma
    if s < 0.0:
        return Gamma
    return 0.0


@njit
def saturation(s: float, a: float, b: float, d: float, Gamma: float, width: float) -> float:
    """Boundary layer: linear within abs(s) <= width. Leaves a steady error set by the width, whatever dt."""
    return -Gamma * clip(s / width, 1.0)


@njit
def implicit(s: float, a: float, b: float, d: float, Gamma: float, width: float) -> float:
    """Set-valued sign of the next s: v_L in -Gamma Sgn(a + b v_L), whose solution is a projection.

    Stable for p in (0, 2), that is for abs(Delta_3) < 1; the surface is missed by O(dt).
    """
    return -clip(a / b, Gamma)


@njit
def implicit_observer(s: float, a: float, b: float, d: float, Gamma: float, width: float) -> float:
    """`implicit` with the disturbance seen over the last interval added. Stable for p in (0, 4/3); misses by O(dt^2)."""
    return -clip(a / b + d, Gamma)


class SwitchingLaw(NamedTuple):
    """A law and the interval of true over nominal input gains p it is stable for."""

    law: Law
    stable: tuple[float, float]


SWITCHINGS = {
    "sign": SwitchingLaw(sign, (0.0, float("inf"))),
    "saturation": SwitchingLaw(saturation, (0.0, float("inf"))),
    "implicit": SwitchingLaw(implicit, (0.0, 2.0)),
    "implicit-observer": SwitchingLaw(implicit_observer, (0.0, 4.0 / 3.0)),
}
