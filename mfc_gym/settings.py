"""The options of the environments, and what follows from them before anything is compiled."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mfc_gym import driving, plant
from mfc_gym.actuator import Actuator
from mfc_gym.checks import mapping, positive
from mfc_gym.differentiators import DIFFERENTIATORS
from mfc_gym.sensors import Sensors

SCENARIOS = ("paper", "random")
UNCERTAINTY = {  # of the distance of the declared set from the nominal theta, the nearest to 0
    "nominal": 0.0,
    "mild": 0.5,
    "hard": 1.0,  # all that the bounds cover
    "beyond": 1.5,  # only what the bounds do not cover
}
DERIVATIVES = ("exact", *DIFFERENTIATORS)


@dataclass(frozen=True)
class Settings:
    """Options of the environment; None means the plant's own task."""

    system: str = "PerturbedChain"
    scenario: str = "paper"
    uncertainty: str = "hard"  # how far theta lies from its nominal value, see UNCERTAINTY
    unmatchedness: float = 1.0  # 0: the same size of uncertainty enters where the input does, see `mfc_gym.varying`
    theta: tuple[float, ...] | None = None
    schedule: Mapping[str, Any] | None = None  # theta -> {"wave": of `mfc_gym.waves`, its parameters}, added to it
    disturbance: Mapping[str, Any] | None = None  # "u" or a state -> the same, added to that row of x'
    actuator: Mapping[str, Any] | None = None  # see `mfc_gym.actuator.Actuator`
    initial_state: tuple[float, ...] | None = None
    reference: str | None = None
    reference_parameters: Mapping[str, float] | None = None
    derivatives: str = "exact"  # how xi_n is obtained: exactly, or by a differentiator on the sampled y
    differentiator: Mapping[str, float] | None = None  # its settings, see `mfc_gym.differentiators`
    sensors: Mapping[str, Any] | None = None  # see `mfc_gym.sensors.Sensors`
    dt: float | None = None  # s
    horizon: float | None = None  # s
    input_limit: float | None = None
    cost: str = "absolute"
    cost_max: float | None = None
    effort: float = 0.0  # weight of u^2 in the cost
    tolerance: float = 1e-8  # error of the plant's integration per control step
    substeps: int | None = None  # None: from the tolerance


def varied_plant(given: Settings, options: Mapping[str, Any]) -> tuple[plant.Plant, float, driving.Driving]:
    """The plant with the uncertainty that is asked for, the sampling time, and what moves."""
    dt = given.dt
    schedule, disturbance = mapping("schedule", given.schedule), mapping("disturbance", given.disturbance)
    actuator = Actuator.of(given.actuator)
    if dt is None:
        dt = plant.load(given.system, **options).task.dt
    dt = positive("dt", dt)
    unmatchedness = positive("unmatchedness", given.unmatchedness, or_zero=True)
    found = plant.load(given.system, driving.variation(unmatchedness, schedule, disturbance, dt), **options)
    return found, dt, driving.driving(found, schedule, disturbance, actuator, dt)


def measurement(given: Settings) -> tuple[Sensors | None, list[float]]:
    """The sensors (None: x and xi_n are known exactly) and their part of the step's settings."""
    sensors = Sensors.of(given.sensors)
    if given.derivatives == "exact":
        if sensors != Sensors() or given.differentiator:
            raise ValueError(
                "`sensors` and `differentiator` must come with derivatives = one of "
                f"{sorted(DIFFERENTIATORS)}, got derivatives = 'exact'."
            )
        return None, []
    tuning = dict(DIFFERENTIATORS[given.derivatives].settings)
    own = mapping("differentiator", given.differentiator)
    if unknown := set(own) - set(tuning):
        raise ValueError(f"`differentiator` must have keys among {sorted(tuning)}, got {sorted(map(str, unknown))}.")
    tuning |= {name: positive(f"{name} of the differentiator", value) for name, value in own.items()}
    return sensors, [sensors.noise, sensors.state_noise, sensors.quantisation, sensors.dropout, *tuning.values()]
