"""Variations of a plant: the same equations with the uncertainty turned, moving in time, or joined by a disturbance.

Each is a function from FlatSystem to FlatSystem, the bounds that a controller may know included; so a variation is checked,
compiled and simulated like any plant. Which theta are admissible is what the plant itself says, for every variation of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import sympy as sp

from mfc_gym.enclosure import bound_of, sharp_bound_of
from mfc_gym.flat_system import FlatSystem
from mfc_gym.uncertainty import Uncertainty
from mfc_gym.variation import Variation, disturbance_name, rate_name

INPUT = "u"  # the channel of a matched disturbance


def varied(system: FlatSystem, variation: Variation) -> FlatSystem:
    """The plant with all of it. Raises ValueError for what the plant does not have."""
    if variation.unmatchedness != 1.0:
        system = turned(system, variation.unmatchedness)
    for name, bounds in variation.moving.items():
        system = moving(system, name, bounds)
    for channel, bounds in variation.disturbances.items():
        system = disturbed(system, channel, bounds)
    return system


def turned(system: FlatSystem, unmatchedness: float) -> FlatSystem:
    """Delta_u turned towards g at constant size: Delta_m + sqrt(s) Delta_u + sqrt(1-s) abs(Delta_u) g / abs(g).

    With s = 1 the plant as it is, with s = 0 an uncertainty that is matched, of the same size at every state.
    Raises ValueError unless 0 <= s <= 1.
    """
    if not 0 <= unmatchedness <= 1:
        raise ValueError(f"`unmatchedness` must lie in [0, 1], got {unmatchedness}.")
    s = sp.nsimplify(unmatchedness, rational=True)
    matched, unmatched = system.decomposition
    size_of_g = sp.sqrt(sp.Add(*(g**2 for g in system.g)))
    size = sp.sqrt(sp.Add(*(e**2 for e in unmatched)))
    kept = tuple(a + sp.sqrt(s) * b for a, b in zip(matched, unmatched, strict=True))
    added = tuple(sp.sqrt(1 - s) * size * g / size_of_g for g in system.g)
    part = replace(system, Delta=kept, bounds={}, origin=system)
    u = Uncertainty(part)
    bounds = {"delta_3": bound_of(u, "delta_3", part.Delta_3)}
    gain = sp.sqrt(1 - s) * sp.Abs(system.beta) / size_of_g  # L_added L_f^(n-1) h per size
    size_bound = sp.sqrt(sp.Add(*(bound_of(u, "Delta_u", e) ** 2 for e in unmatched)))
    bounds["delta_1"] = bound_of(u, "delta_1", part.Delta_1) + (1 + bounds["delta_3"]) * gain * size_bound
    bounds["delta_m"] = bound_of(u, "delta_m", part.phi_m) + gain * size_bound
    bounds["sharp_1"] = sharp_bound_of(u, "sharp_1", part.Delta_1, bounds["delta_3"]) + gain * size_bound
    bounds["sharp_3"] = sharp_bound_of(u, "sharp_3", part.Delta_3, bounds["delta_3"])
    Delta = tuple(a + b for a, b in zip(kept, added, strict=True))
    return replace(system, Delta=Delta, bounds=bounds, origin=system)


def moving(system: FlatSystem, name: str, bounds: Sequence[float]) -> FlatSystem:
    """`name` of theta moves in time, abs(theta^(k)) <= bounds[k-1] for k = 1 ... n-1: its rates are further theta.

    Raises ValueError for a theta that the plant does not have.
    """
    if name not in system.theta:
        raise ValueError(f"`schedule` must be of {sorted(system.theta)}, got {name!r}.")
    return _with_theta(system, name, {}, bounds, system.Delta)


def disturbed(system: FlatSystem, channel: str, bounds: Sequence[float]) -> FlatSystem:
    """An exogenous disturbance d(t) added to x' in the direction g (channel "u") or in one row of the state.

    abs(d^(k)) <= bounds[k] for k = 0 ... n-1. Raises ValueError for an unknown channel, or if d takes the relative degree.
    """
    if channel != INPUT and channel not in system.state:
        raise ValueError(f"`disturbance` must enter through {INPUT!r} or one of {system.state}, got {channel!r}.")
    name = disturbance_name(channel)
    d = sp.Symbol(name, real=True)
    direction = system.g if channel == INPUT else tuple(sp.Integer(x == channel) for x in system.state)
    Delta = tuple(a + d * b for a, b in zip(system.Delta, direction, strict=True))
    return _with_theta(system, name, {name: (-bounds[0], bounds[0])}, bounds[1:], Delta)


def _with_theta(
    system: FlatSystem,
    name: str,
    own: Mapping[str, tuple[float, float]],
    rates: Sequence[float],
    Delta: tuple[sp.Expr, ...],
) -> FlatSystem:
    """`own` and the rates of `name` as further theta; to each bound what they add to that which it bounds."""
    further = dict(own)
    further |= {rate_name(name, k): (-rates[k - 1], rates[k - 1]) for k in range(1, system.order)}
    chain = {rate_name(name, k): rate_name(name, k + 1) for k in range(system.order - 1)}
    task = system.task
    if task.theta is not None:
        task = replace(task, theta=(*task.theta, *(0.0 for _ in further)))
    varied = replace(
        system,
        theta={**system.theta, **further},
        rates={**system.rates, **chain},
        Delta=Delta,
        task=task,
        origin=system,
    )
    u = Uncertainty(varied)
    change_1, change_3 = varied.Delta_1 - system.Delta_1, varied.Delta_3 - system.Delta_3
    more_3 = bound_of(u, "delta_3", change_3)
    delta_3 = system.bounds["delta_3"] + more_3
    more = {
        "delta_1": bound_of(u, "delta_1", change_1),
        "delta_m": bound_of(u, "delta_m", varied.phi_m - system.phi_m),
        "sharp_1": sharp_bound_of(u, "sharp_1", change_1, delta_3),
    }
    kept = set(system.bounds) - (
        {"sharp_1", "sharp_3"} if more_3 else set()
    )  # their denominator 1 + Delta_3 is another one
    return replace(varied, bounds={k: system.bounds[k] + more.get(k, 0) for k in kept} | {"delta_3": delta_3})
