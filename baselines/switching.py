"""The discontinuous control v_L = -Gamma sgn(w) in sampled time: laws for the set-valued sign.

All take (s, a, b, d, Gamma, keep, width): s = w / 2 now; a the predicted next s with v_L = 0 and b > 0 its gain to v_L, so
that s_next = a + b v_L in the nominal model; d the disturbance estimate in units of v_L, abs(d) <= Gamma; `keep` the fraction
of s that one interval leaves (0: the surface is reached in one step); `width` of a boundary layer, unit of s.

With p = 1 + Delta_3, the true input gain over the nominal one, sigma = s / b and keep = 0, the loop near the surface is

    implicit:           sigma_next = (1 - p) sigma + D                      stable for p in (0, 2), contraction abs(1 - p)
    implicit-observer:  sigma_next = (1 - p) sigma - p d + D,  d_next = d + rate sigma_next

with D what the model does not know. The observer's characteristic polynomial is z^2 - (2 - p - rate p) z - (p - 1): stable for
p in (0, 4 / (2 + rate)), and the disturbance is cancelled, sigma = O(dt) and s = O(dt^2) for a smooth one. Its product of
poles is 1 - p: no rate contracts faster than sqrt(delta_3) for all abs(Delta_3) <= delta_3, and `best_rate` does just that.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from numba import njit

Law = Callable[[float, float, float, float, float, float, float], float]


@njit
def clip(value: float, limit: float) -> float:
    """Projection to [-limit, limit]."""
    return min(max(value, -limit), limit)


@njit
def best_rate(delta_3: float) -> float:
    """The rate that contracts fastest, by sqrt(delta_3) per step, for all abs(Delta_3) <= delta_3 < 1.

    At p = 1 + delta_3 the poles are +-sqrt(delta_3), at p = 1 - delta_3 they are complex of that modulus.
    """
    return (1.0 - delta_3) / (1.0 + delta_3)


@njit
def sign(s: float, a: float, b: float, d: float, Gamma: float, keep: float, width: float) -> float:
    """Explicit sign, eq. (22) of [1] evaluated at the sample; sgn(0) = 0. Chatters with amplitude O(dt)."""
    if s > 0.0:
        return -Gamma
    if s < 0.0:
        return Gamma
    return 0.0


@njit
def saturation(s: float, a: float, b: float, d: float, Gamma: float, keep: float, width: float) -> float:
    """Boundary layer: linear within abs(s) <= width. Leaves a steady error set by the width, whatever dt."""
    return -Gamma * clip(s / width, 1.0)


@njit
def average(s: float, a: float, b: float, Gamma: float, keep: float) -> float:
    """Mean of the continuous-time v_L over the interval, to second order, from the s it starts at and a, its end for v_L = 0.

    v_eq = (s - a) / b would hold s. If abs(v_eq) <= Gamma the surface is kept once reached: v_L in
    -Gamma Sgn(a + b v_L - keep s), whose solution is a projection. Otherwise it may be crossed, after the fraction phi of the
    interval, and v_L changes sign there.
    """
    v_eq = (s - a) / b
    if s * v_eq > 0.0 and abs(v_eq) > Gamma:
        phi = min(abs(s) / (b * (abs(v_eq) + Gamma)), 1.0)
        return math.copysign(1.0, s) * Gamma * (1.0 - 2.0 * phi)
    return -clip((a - keep * s) / b, Gamma)


@njit
def implicit(s: float, a: float, b: float, d: float, Gamma: float, keep: float, width: float) -> float:
    """Set-valued sign of the next s: v_L in -Gamma Sgn(a + b v_L), whose solution is a projection.

    Stable for p in (0, 2), that is for abs(Delta_3) < 1; the surface is missed by O(dt).
    """
    return average(s, a, b, Gamma, keep)


@njit
def implicit_observer(s: float, a: float, b: float, d: float, Gamma: float, keep: float, width: float) -> float:
    """`implicit` with the estimate of the disturbance added. Stable for p in (0, 4 / (2 + rate)); misses by O(dt^2)."""
    return average(s, a + b * d, b, Gamma, keep)


class SwitchingLaw(NamedTuple):
    """A law and the interval of true over nominal input gains p it is stable for, given the rate of its estimate."""

    law: Law
    stable: Callable[[float], tuple[float, float]]
    averages: bool  # aims at the mean of the continuous-time law over the interval, not at its value at the sample


SWITCHINGS = {
    "sign": SwitchingLaw(sign, lambda rate: (0.0, math.inf), averages=False),
    "saturation": SwitchingLaw(saturation, lambda rate: (0.0, math.inf), averages=False),
    "implicit": SwitchingLaw(implicit, lambda rate: (0.0, 2.0), averages=True),
    "implicit-observer": SwitchingLaw(implicit_observer, lambda rate: (0.0, 4.0 / (2.0 + rate)), averages=True),
}
