"""The compiled step of the environment: zero-order hold, plant, clock, measurement, reward. Scalar and batch share it.

An episode is one row of numbers, [x (n), theta (p), reference parameters (r), sensor memory (m), what moves, clock]. What all
episodes share is `settings`, [dt, substeps, input_limit, steps, cost_max, effort, low (n), high (n)] and, with sensors that are
not ideal, their own (`mfc_gym.sensing`). What moves: see `mfc_gym.driving`.
"""

from itertools import product
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from mfc_gym import driving, kernels, sensing
from mfc_gym.differentiators import DIFFERENTIATORS
from mfc_gym.driving import NOTHING, Driving
from mfc_gym.plant import Plant
from mfc_gym.references import Reference
from mfc_gym.sensors import Sensors

Array = NDArray[np.float64]

BLOCK = 128  # episodes that are integrated side by side, so that the compiler uses vector instructions

ADVANCE_ALL_TYPES = (
    "void(float64[:, ::1], float64[::1], boolean[::1], float64[::1], float64[::1], float64[:, ::1], int64, int64, "
    "float64[:, ::1], float64[:, ::1], float64[::1], boolean[:, ::1])"
)

TEMPLATE = '''"""Generated: the environment step of a plant following the reference {reference!r}. Do not edit."""

import numpy as np
from mfc_gym.compiled import entry, method, njit

from mfc_gym.references import {reference} as reference
from mfc_gym.reward import reward
from mfc_gym.reward import {cost} as cost
from mfc_gym.streams import random as draw
from {plant} import admissibility, integrate, is_inside, is_near, output_derivatives, rk4

{sensing}
{driven}

@njit
def observe_plant(row, settings, observation):
    """Writes [x, xi_n]."""
    {state} = {state_of_row}
    {observe_plant}


@njit
def output(row):
    """The true y."""
    {state} = {state_of_row}
    return output_derivatives({arguments})[0]


@njit
def observe_reference(row, t, observation):
    """Writes [y_d ... y_d^(n)] at time t."""
    reference(t, row[{reference_slice}], observation[{reference_start}:])


@njit
def saturated(action, settings):
    """u."""
    return settings[2] * min(max(action, -1.0), 1.0)


@njit
def conclude(error, u, inside, clock, settings):
    """(reward, terminated, truncated) of the step that led here."""
    dt, steps = settings[0], settings[3]
    remaining = 0.0 if inside else max(steps - clock, 0.0)
    gain = reward(cost(error, u, settings[5]), settings[4], dt, remaining)
    return gain, not inside, inside and clock >= steps


@njit
def advance(row, action, settings, observation):
    """One sampling interval: (reward, terminated, truncated); row and observation are updated."""
    dt, substeps, u = settings[0], int(settings[1]), saturated(action, settings)
    low, high = settings[6:{high_start}], settings[{high_start}:{high_end}]
    {integrate_step}
    {state_of_row} = {state}
    row[{clock}] += 1.0
    {drive_step}
    {observe_step}
    observe_reference(row, row[{clock}] * dt, observation)
    return conclude(output(row) - observation[{reference_start}], u, inside, row[{clock}], settings)


@entry("void(float64[::1], float64[::1], float64[::1])")
def first_observation(row, settings, observation):
    """Writes the observation at time 0."""
    observe_plant(row, settings, observation)
    observe_reference(row, 0.0, observation)


@method({memory_size})
def advance_one(memory, action):
    """The scalar environment's step, that is `advance` in the memory [row, settings, observation]."""
    return advance(memory[:{row_size}], action, memory[{row_size}:{observation_start}], memory[{observation_start}:])


{advance_all}

'''

BLOCKS = '''@njit(error_model="numpy")
def integrate_block(x, theta, u, inside, count, settings):
    """`integrate` of `count` episodes side by side; x and `inside` (1.0 or 0.0) are updated, what is not inside stays."""
    substeps, low, high = int(settings[1]), {low}, {high}
    h = settings[0] / substeps
    for _ in range(substeps):
        for j in range(count):
            {next_state} = rk4({block_arguments}, u[j], h)
            within = is_inside({next_state}, low, high)
            moves = (inside[j] > 0.0) & (within | is_near({next_state}, low, high))
{block_update}
            inside[j] = inside[j] if within else 0.0


@entry({advance_all_types})
def advance_all(
    columns, settings, active, fresh, actions, work, start, stop, table, observations, rewards, ends
):
    """`advance` of the episodes start to stop; one that is not active is observed as it is, its action does not count.

    Episodes are columns here, shape (row, N). Those that are not active begin anew with the row `fresh`, if it is one, shape
    (row,), else (0,). If all have the same reference, the table holds it, (samples, n+1); else it has no samples. `ends`
    receives terminated and truncated, (2, N). Short loops over a block, one after the other, become vector instructions; they
    work in `work`, of shape WORK.
    """
    x, theta, u, inside = work[:{n}], work[{n} : {n} + {p}], work[{n} + {p}], work[{n} + {p} + 1]
    for first in range(start, stop, {block}):
        count = min({block}, stop - first)
        if fresh.size > 0:
            for i in range(first, first + count):
                if not active[i]:
                    for k in range(fresh.size):
                        columns[k, i] = fresh[k]
        tabulated = True
        for j in range(count):
            i = np.uintp(first + j)
            {block_arguments} = {start_of_columns}
        for j in range(count):
            i = np.uintp(first + j)
            inside[j] = 1.0 if active[i] else 0.0
            columns[{clock}, i] += 1.0 if active[i] else 0.0
        for j in range(count):
            i = np.uintp(first + j)
            u[j] = saturated(actions[i], settings)
        for j in range(count):
            i = np.uintp(first + j)
            tabulated = tabulated & (columns[{clock}, i] < table.shape[0])
        integrate_block(x, theta, u, inside, count, settings)
        for j in range(count):
            i = np.uintp(first + j)
            {state_of_columns} = {state_of_block}
        for j in range(count):
            i = np.uintp(first + j)
            {observe_block}
        if tabulated:
            for j in range(count):
                i = np.uintp(first + j)
                k = np.uintp(columns[{clock}, i])
                {observed_references} = {references_of_table}
        else:
            for i in range(first, first + count):
                reference(columns[{clock}, i] * settings[0], columns[{reference_slice}, i], observations[i, {reference_start}:])
        for j in range(count):
            i = np.uintp(first + j)
            error = {output_of_block} - observations[i, {reference_start}]
            gain, terminates, is_last = conclude(error, u[j], inside[j] > 0.0, columns[{clock}, i], settings)
            rewards[i] = gain if active[i] else 0.0
            ends[0, i] = terminates & active[i]
            ends[1, i] = is_last & active[i]
'''

EPISODES = '''WORK = {work}


@entry("void(float64[::1], float64, float64[:, ::1])")
def tabulate(parameters, dt, table):
    """The reference at the samples 0, 1, ..."""
    for k in range(table.shape[0]):
        reference(k * dt, parameters, table[k])


@entry("void(float64[:, ::1], float64[::1], boolean[::1], float64[::1], float64[:, ::1])")
def observe_all(columns, settings, chosen, row, observations):
    """The observations of the chosen episodes as they are; `row` is worked in."""
    for i in range(observations.shape[0]):
        if chosen[i]:
            for k in range(row.size):
                row[k] = columns[k, i]
            observe_plant(row, settings, observations[i])
            observe_reference(row, row[{clock}] * settings[0], observations[i])
            for k in range({sensor_start}, {clock}):
                columns[k, i] = row[k]


@entry("void(float64[:, ::1], float64[::1])")
def outputs(rows, out):
    """The true y of each row."""
    for i in range(rows.shape[0]):
        out[i] = output(rows[i])


@njit
def offence(row, beyond):
    """(Delta_3, delta_3) where theta, wherever it moves, breaks abs(Delta_3) <= delta_3, which every redesign controller is told.

    `beyond`: only Delta_3 > -1 counts, the least that keeps the relative degree. (nan, nan): nothing is broken.
    """
    {state} = {state_of_row}
    for declared, delta_3, Delta_3 in ({corners},):
        if not Delta_3 > -1.0:
            return Delta_3, 1.0
        if not (beyond or abs(declared) <= delta_3 * (1.0 + 1e-12)):
            return declared, delta_3
    return np.nan, np.nan


@njit
def is_admissible(row, beyond):
    """Whether there is no offence; `beyond`: and theta is outside of what the bounds cover."""
    allowed = np.isnan(offence(row, beyond)[0])
    return allowed and ({outside} or not np.isnan(offence(row, False)[0])) if beyond else allowed


@entry("int64(float64[:, ::1], boolean, float64[::1])")
def inadmissible(rows, beyond, found):
    """Index of the first row with an offence, which is written to `found`; -1: there is none."""
    for i in range(rows.shape[0]):
        found[0], found[1] = offence(rows[i], beyond)
        if not np.isnan(found[0]):
            return i
    return -1


@entry(
    "boolean(float64[:, ::1], uint64[:, ::1], int64, boolean, float64[::1], float64[::1], int64[::1], float64[::1], float64[::1])"
)
def draw_all(rows, streams, attempts, beyond, theta_low, theta_high, columns, low, high):
    """Draws, each row from its own stream, theta and then the numbers of the columns (-1: dropped), uniformly.

    Theta is drawn until it is admissible at the row's state. Returns whether the attempts were enough.
    """
    for i in range(rows.shape[0]):
        row, stream = rows[i], streams[i]
        found = attempts == 0
        for _ in range(attempts):
            for k in range({declared}):
                row[{n} + k] = theta_low[k] + (theta_high[k] - theta_low[k]) * draw(stream)
            if is_admissible(row, beyond):
                found = True
                break
        if not found:
            return False
        for k in range(columns.size):
            value = low[k] + (high[k] - low[k]) * draw(stream)
            if columns[k] >= 0:
                row[columns[k]] = value
    return True
'''


HELD = {
    "integrate_step": """{state} = {state_of_row}
    {state}, inside = integrate({arguments}, u, dt / substeps, substeps, low, high)""",
    "drive_step": "",
}


def corners(state: list[str], n: int, p: int, moving: Driving) -> list[str]:
    """The arguments (x, theta) at the ends of the intervals that the plant's own theta move in; those alone if none does."""
    theta = [[f"row[{n + i}]"] for i in range(p)]
    for mover in moving.movers:
        if mover.declared:
            column = mover.columns[0]
            theta[column] = [f"row[{n + column}] + {end!r}" for end in mover.extent]
    return [", ".join([*state, *chosen]) for chosen in product(*theta)]


def outside(plant: Plant, n: int) -> str:
    """Whether a row's theta lies outside the declared box."""
    low, high = plant.theta_set
    ends = enumerate(zip(low, high, strict=True), start=n)
    return " or ".join(f"row[{i}] < {float(a)!r} or row[{i}] > {float(b)!r}" for i, (a, b) in ends) or "False"


def load(
    plant: Plant,
    reference: Reference,
    cost: str,
    sensors: Sensors | None = None,
    derivatives: str = "exact",
    moving: Driving = NOTHING,
) -> ModuleType:
    """The compiled step of this plant, reference family and cost; `sensors` None: x and xi_n are known exactly."""
    n, p, r = plant.order, len(plant.parameters), len(reference.defaults)
    name = reference.derivatives.__name__
    start = n + p + r
    base = start + sensing.sensor_memory(n, sensors)
    state, clock = [f"x{i + 1}" for i in range(n)], base + moving.memory
    block = [*(f"x[{i}, j]" for i in range(n)), *(f"theta[{i}, j]" for i in range(p))]
    words = {
        "reference": name,
        "cost": cost,
        "plant": plant.kernel.__name__,
        "nominal": plant.nominal.__name__,
        "n": n,
        "n1": n + 1,
        "n2": 2 * n,
        "p": p,
        "block": BLOCK,
        "work": (n + p + 2, max(BLOCK, clock + 1)),
        "advance_all_types": repr(ADVANCE_ALL_TYPES),
        "state": ", ".join(state),
        "state_of_row": ", ".join(f"row[{i}]" for i in range(n)),
        "state_of_block": ", ".join(block[:n]),
        "declared": len(plant.theta),
        "corners": ", ".join(f"admissibility({c})" for c in corners(state, n, p, moving)),
        "outside": outside(plant, n),
        "arguments": ", ".join([*state, *(f"row[{n + i}]" for i in range(p))]),
        "block_arguments": ", ".join(block),
        "start_of_columns": ", ".join(f"columns[{i}, i]" for i in range(n + p)),
        "state_of_columns": ", ".join(f"columns[{i}, i]" for i in range(n)),
        "next_state": ", ".join(f"n{s}" for s in state),
        "block_update": "\n".join(f"            x[{i}, j] = n{s} if moves else x[{i}, j]" for i, s in enumerate(state)),
        "low": "(" + "".join(f"settings[{6 + i}], " for i in range(n)) + ")",
        "high": "(" + "".join(f"settings[{6 + n + i}], " for i in range(n)) + ")",
        "observed_states": ", ".join(f"observations[i, {k}]" for k in range(n)),
        "observed_derivatives_of_block": ", ".join(f"observations[i, {n + k}]" for k in range(n)),
        "observed_references": ", ".join(f"observations[i, {2 * n + k}]" for k in range(n + 1)),
        "references_of_table": ", ".join(f"table[k, {k}]" for k in range(n + 1)),
        "observed_state": ", ".join(f"observation[{i}]" for i in range(n)),
        "observed_derivatives": ", ".join(f"observation[{n + i}]" for i in range(n)),
        "output": n,
        "reference_slice": f"{n + p}:{start}",
        "reference_start": 2 * n,
        "high_start": 6 + n,
        "high_end": 6 + 2 * n,
        "sensors": 6 + 2 * n,
        "sensor_start": start,
        "estimate": 2 + n,
        "ring": 2 + 2 * n,
        "delay": sensors.delay if sensors else 0,
        "distribution": sensors.distribution if sensors else "",
        "differentiator": DIFFERENTIATORS[derivatives].update.__name__ if sensors else "",
        "floor": sensing.FLOOR,
        "clock": clock,
    }
    ranges = 10 + 2 * n + len(DIFFERENTIATORS[derivatives].settings) if sensors else 0
    tuning = ranges + 4 * n if sensors else 6 + 2 * n
    words["ranges"] = ranges
    observation_start = clock + 1 + tuning + len(moving.tuning)
    words |= {
        "row_size": clock + 1,
        "observation_start": observation_start,
        "memory_size": observation_start + 3 * n + 1,
    }
    words["driven"] = driving.source(words, moving, n, p, base, tuning) if moving.moves else ""
    parts = {key: text.format(**words) for key, text in (sensing.SENSED if sensors else sensing.IDEAL).items()}
    parts |= {key: text.format(**words) for key, text in (driving.DRIVEN if moving.moves else HELD).items()}
    parts["advance_all"] = (driving.ADVANCE_ALL if moving.moves else BLOCKS).format(**words, **parts)
    source = (TEMPLATE + EPISODES).format(**words, **parts)
    library = kernels.files(
        "mfc_gym",
        *(
            "references",
            "reward",
            "sensors",
            "differentiators",
            "streams",
            "waves",
            "actuator",
        ),
    )
    return kernels.load(f"mfc_step_{kernels.key(source, kernels.fingerprint(*library))}", lambda: source)
