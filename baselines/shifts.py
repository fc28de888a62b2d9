"""The shifts of a comparison: what changes between the task an agent was trained for and the one it meets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mfc_gym.simulation import Simulation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shift:
    """A change of the task; the factors are relative to the task compared on."""

    title: str
    keywords: Mapping[str, Any] = field(default_factory=dict)  # of the environment
    dt: float = 1.0  # factor of the sampling time
    horizon: float = 1.0  # factor of the length of an episode
    noise: float | None = None  # on y, in units of the reference; xi_n is then differentiated
    initial: float = 1.0  # factor of the initial state's distance from the middle of its set

    def applies(self, given: Mapping[str, Any], base: Simulation) -> bool:
        """Whether the shift changes anything: the plant has a set of initial states, its reference is another one."""
        own = given.get("reference") or base.plant.task.reference
        return (self.initial == 1.0 or bool(base.plant.task.initial_set)) and self.keywords.get("reference") != own

    def options(self, given: Mapping[str, Any], base: Simulation) -> dict[str, Any]:
        """The environment's keywords under this shift; `given`: those of the task, `base`: what they make."""
        clock = {"dt": self.dt * base.dt, "horizon": self.horizon * base.horizon}
        measured = {
            "derivatives": DIFFERENTIATOR,
            "sensors": {"noise": (self.noise or 0.0) * base.plant.task.reference_scale},
        }
        return {**given, **clock, **(measured if self.noise is not None else {}), **self.keywords}

    def reset_options(self, envs: Any, seed: int) -> dict[str, Array] | None:
        """Options for `reset(seed=seed)` of a vector environment, whose theta and references stay as drawn."""
        if self.initial == 1.0:
            return None
        envs.reset(seed=seed)
        simulation: Simulation = envs.unwrapped.simulation
        x = envs.unwrapped.rows[:, : simulation.plant.order]
        sets = simulation.plant.task.initial_set
        middle = x.copy()
        for i, name in enumerate(simulation.plant.state):
            if name in sets:
                middle[:, i] = sum(sets[name]) / 2
        return {"initial_state": np.clip(middle + self.initial * (x - middle), simulation.low, simulation.high)}


IN_DISTRIBUTION = "in-distribution"
DIFFERENTIATOR = "ired"

SHIFTS: dict[str, Shift] = {
    IN_DISTRIBUTION: Shift("in distribution"),
    "beyond": Shift("theta beyond its set", {"uncertainty": "beyond"}),
    "half-matched": Shift("uncertainty half unmatched", {"unmatchedness": 0.5}),
    "matched": Shift("uncertainty matched", {"unmatchedness": 0.0}),
    "initial": Shift("initial states twice as far out", initial=2.0),
    "noise": Shift("noise of 1e-5 on y, differentiated", noise=1e-5),
    "more-noise": Shift("noise of 1e-3 on y, differentiated", noise=1e-3),
    "faster": Shift("sampling twice as fast", dt=0.5),
    "slower": Shift("sampling half as fast", dt=2.0),
    "multisine": Shift("reference of three sines", {"reference": "multisine", "reference_parameters": None}),
    "step": Shift("reference of smooth steps", {"reference": "step", "reference_parameters": None}),
    "longer": Shift("episodes twice as long", horizon=2.0),
}


def chosen(names: tuple[str, ...]) -> dict[str, Shift]:
    """The shifts of these names, in distribution first; all of them for none. Raises ValueError with the known names."""
    if unknown := sorted(set(names) - set(SHIFTS)):
        raise ValueError(f"`shifts` must be among {', '.join(SHIFTS)}, got {', '.join(unknown)}.")
    wanted = {IN_DISTRIBUTION, *(names or SHIFTS)}
    return {name: shift for name, shift in SHIFTS.items() if name in wanted}
