"""The compiled step where the input or the uncertain parameters move within the sampling interval.

So do disturbances, scheduled parameters and an actuator with a lag. Further columns of an episode's row: base [the drawn value of
every theta that moves], key of what is random, the actuator's memory [last input, distance of the lag from its end, the delayed
inputs], and room for one wave with its derivatives. Further settings: parameters of the waves, then those of the actuator. The
integrator is Runge-Kutta's, its stages taken at the times they stand for.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mfc_gym import waves
from mfc_gym.actuator import IDEAL, Actuator
from mfc_gym.plant import Plant
from mfc_gym.variation import Variation, disturbance_name, rate_name
from mfc_gym.waves import WAVES

MOST = 1024  # substeps
RATES = 16  # derivatives of a wave that are bounded; a plant of order n needs n - 1


@dataclass(frozen=True)
class Mover:
    """A theta that moves: where it and its rates stand in theta, and how."""

    name: str
    columns: tuple[int, ...]  # of theta: the value, then its rates
    family: str  # of WAVES
    parameters: tuple[float, ...]
    quickness: float  # 1/s, largest abs(d') over the largest abs(d)
    declared: bool  # whether it is one of the plant's own theta, rather than a disturbance
    extent: tuple[float, float]  # of what is added to the base


@dataclass(frozen=True)
class Driving:
    """All that moves."""

    movers: tuple[Mover, ...] = ()
    actuator: Actuator = IDEAL

    @property
    def moves(self) -> bool:
        """Whether there is anything."""
        return bool(self.movers) or self.actuator != IDEAL

    @property
    def memory(self) -> int:
        """Numbers per episode, see above."""
        return len(self.movers) + 1 + self.actuator.memory + self.jets if self.moves else 0

    @property
    def jets(self) -> int:
        """Numbers that a wave and its derivatives take, at most."""
        return max((len(mover.columns) for mover in self.movers), default=0)

    def substeps(self, dt: float) -> int:
        """As many as integrate what moves, too, below the default tolerance: steps of 1/20 of its time constant."""
        rates = [1.0 / self.actuator.lag] if self.actuator.lag else []
        rates += [mover.quickness for mover in self.movers]
        return min(MOST, math.ceil(20.0 * dt * max(rates, default=0.0)) or 1)

    @property
    def tuning(self) -> list[float]:
        """Its part of the step's settings."""
        waves = [value for mover in self.movers for value in mover.parameters]
        return [*waves, *self.actuator.tuning] if self.moves else []


NOTHING = Driving()

DRIVEN = {
    "integrate_step": """u, gap = actuate(row, u, settings)
    {state}, inside = integrate_driven(row, u, gap, settings)""",
    "drive_step": "drive(row, row[{clock}] * dt, 0.0, settings)",
}

TEMPLATE = '''{imports}
from mfc_gym.actuator import slewed
from mfc_gym.sensors import quantised
from {plant} import field


@njit
def drive(row, begin, s, settings):
    """Theta at the time begin + s, as the sampling interval from `begin` on has it."""
    out = row[{jet} : {jet} + {jets}]
{drive}


@njit
def actuate(row, demanded, settings):
    """The input that acts from now on, and what a lag has still to go at first."""
    u = demanded
    if {input_delay} > 0:
        slot = {inputs} + int(row[{clock}]) % {input_delay}
        u, row[slot] = row[slot], u
    u = slewed(quantised(u, settings[{tuning}]), row[{last}], settings[{tuning} + 1] * settings[0])
    gap = row[{gap}] + row[{last}] - u if settings[{tuning} + 2] > 0.0 else 0.0
    row[{last}] = u
    return u, gap


@njit(error_model="numpy")
def integrate_driven(row, u, gap, settings):
    """State after the sampling interval, and whether it stayed inside the region; as `integrate`."""
    dt, substeps, lag = settings[0], int(settings[1]), settings[{tuning} + 2]
    low, high = settings[6:{high_start}], settings[{high_start}:{high_end}]
    begin, h = row[{clock}] * dt, dt / substeps
    decay = np.exp(-0.5 * h / lag) if lag > 0.0 else 0.0
    {state} = {state_of_row}
    for m in range(substeps):
        {stages}
        gap *= decay * decay
        row[{gap}] = gap
        if not is_inside({next_state}, low, high):
            if is_near({next_state}, low, high):
                return {next_state}, False
            return {state}, False
        {state} = {next_state}
    return {state}, True


@entry("void(float64[:, ::1], float64[::1])")
def set_all(rows, settings):
    """Notes theta as that about which it moves, and lets it."""
    for i in range(rows.shape[0]):
        row = rows[i]
{note}
        drive(row, row[{clock}] * settings[0], 0.0, settings)


@entry("void(float64[:, ::1], float64[::1])")
def start_all(rows, settings):
    """The same at the beginning of episodes, the actuator at rest."""
    for i in range(rows.shape[0]):
        for k in range({last}, {last} + {actuator_memory}):
            rows[i, k] = 0.0
    set_all(rows, settings)
'''

ADVANCE_ALL = '''@entry({advance_all_types})
def advance_all(
    columns, settings, active, fresh, actions, work, start, stop, table, observations, rewards, ends
):
    """`advance` of the episodes start to stop, one after the other; one that is not active is observed as it is.

    Episodes are columns here, shape (row, N). Those that are not active begin anew with the row `fresh`, if it is one.
    """
    row = work[0, : {clock} + 1]
    for i in range(start, stop):
        for k in range(row.size):
            row[k] = columns[k, i]
        if active[i]:
            rewards[i], ends[0, i], ends[1, i] = advance(row, actions[i], settings, observations[i])
        else:
            if fresh.size > 0:
                for k in range(row.size):
                    row[k] = fresh[k]
            rewards[i], ends[0, i], ends[1, i] = 0.0, False, False
            observe_plant(row, settings, observations[i])
            observe_reference(row, row[{clock}] * settings[0], observations[i])
        for k in range(row.size):
            columns[k, i] = row[k]
'''


def variation(
    unmatchedness: float, schedule: Mapping[str, Any], disturbance: Mapping[str, Any], dt: float
) -> Variation:
    """The plant that these options ask for. Raises ValueError for a wave that is none."""

    def bounds(option: str, name: str, given: Any, first: int) -> tuple[float, ...]:
        family, parameters = waves.of(option, name, given)
        return tuple(WAVES[family].bound(parameters, k, dt) for k in range(first, RATES))

    return Variation(
        unmatchedness,
        {name: bounds("schedule", name, given, 1) for name, given in schedule.items()},
        {name: bounds("disturbance", name, given, 0) for name, given in disturbance.items()},
    )


def driving(
    plant: Plant, schedule: Mapping[str, Any], disturbance: Mapping[str, Any], actuator: Actuator, dt: float
) -> Driving:
    """What moves in this plant, which has been varied accordingly."""
    movers = []
    for option, entries in (("schedule", schedule), ("disturbance", disturbance)):
        for given_name, given in entries.items():
            family, parameters = waves.of(option, given_name, given)
            name = given_name if option == "schedule" else disturbance_name(given_name)
            names = [rate_name(name, k) for k in range(plant.order)]
            columns = tuple(plant.parameters.index(each) for each in names)
            wave, values = WAVES[family], tuple(parameters.values())
            size = wave.bound(parameters, 0, dt)
            quickness = wave.bound(parameters, 1, dt) / size if size else 0.0
            extent = wave.extent(parameters, dt)
            movers.append(Mover(name, columns, family, values, quickness, option == "schedule", extent))
    return Driving(tuple(movers), actuator)


def source(words: Mapping[str, Any], moving: Driving, n: int, p: int, base: int, tuning: int) -> str:
    """The further functions of a step: `base` is the first of the further columns, `tuning` the first of the further settings."""
    movers, actuator = moving.movers, moving.actuator
    key, last = base + len(movers), base + len(movers) + 1
    first = tuning + sum(len(mover.parameters) for mover in movers)
    drive, start = [], tuning
    for i, mover in enumerate(movers):
        stop = start + len(mover.parameters)
        value, *rates = (n + column for column in mover.columns)
        drive.append(
            f"    wave_{mover.family}(begin, s, settings[0], settings[{start}:{stop}], row[{key}] + {i}.0, out)"
        )
        drive.append(f"    row[{value}] = row[{base + i}] + out[0]")
        drive += [f"    row[{column}] = out[{k}]" for k, column in enumerate(rates, start=1)]
        start = stop
    imports = [f"from mfc_gym.waves import {f} as wave_{f}" for f in sorted({m.family for m in movers})]
    return TEMPLATE.format(
        **words,
        imports="\n".join(imports),
        jet=last + actuator.memory,
        jets=moving.jets,
        drive="\n".join(drive) or "    pass",
        note="\n".join(f"        row[{base + i}] = row[{n + m.columns[0]}]" for i, m in enumerate(movers))
        or "        pass",
        input_delay=actuator.delay,
        tuning=first,
        last=last,
        gap=last + 1,
        inputs=last + 2,
        actuator_memory=actuator.memory,
        stages=_stages(n, [f"row[{n + k}]" for k in range(p)]),
    )


def _stages(n: int, theta: Sequence[str]) -> str:
    """One Runge-Kutta step, written out over the state."""
    x = [f"x{i + 1}" for i in range(n)]

    def stage(k: str, point: Sequence[str], u: str) -> str:
        return f"{', '.join(k + s for s in x)}, = field({', '.join([*point, *theta, u])})"

    def shifted(k: str, factor: str) -> list[str]:
        return [f"{s} + {factor} * {k}{s}" for s in x]

    lines = [
        "drive(row, begin, m * h, settings)",
        stage("a", x, "u + gap"),
        "drive(row, begin, (m + 0.5) * h, settings)",
        stage("b", shifted("a", "0.5 * h"), "u + gap * decay"),
        stage("c", shifted("b", "0.5 * h"), "u + gap * decay"),
        "drive(row, begin, (m + 1.0) * h, settings)",
        stage("d", shifted("c", "h"), "u + gap * decay * decay"),
        *(f"n{s} = {s} + h / 6.0 * (a{s} + 2.0 * (b{s} + c{s}) + d{s})" for s in x),
    ]
    return "\n        ".join(lines)
