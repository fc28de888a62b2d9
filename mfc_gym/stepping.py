"""The compiled step of the environment: zero-order hold, plant, clock, measurement, reward. Scalar and batch share it.

An episode is one row of numbers, [x (n), theta (p), reference parameters (r), clock]; what all episodes share is `settings`,
[dt, substeps, input_limit, steps, cost_max, effort, low (n), high (n)].
"""

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from mfc_gym import kernels
from mfc_gym.plant import Plant
from mfc_gym.references import Reference

Array = NDArray[np.float64]

TEMPLATE = '''"""Generated: the environment step of {name!r} following the reference {reference!r}. Do not edit."""

import numpy as np
from numba import njit

from mfc_gym.references import {reference} as reference
from mfc_gym.reward import reward
from mfc_gym.reward import {cost} as cost
from {plant} import integrate, output_derivatives


@njit
def observe(row, t, observation):
    """Writes [x, xi_n, y_d ... y_d^(n)] at time t."""
    {state} = {state_of_row}
    {observed_state} = {state}
    {observed_derivatives} = output_derivatives({arguments})
    reference(t, row[{reference_slice}], observation[{reference_start}:])


@njit
def advance(row, action, settings, observation):
    """One sampling interval: (reward, terminated, truncated); row and observation are updated."""
    dt, substeps, input_limit, steps = settings[0], int(settings[1]), settings[2], settings[3]
    u = input_limit * min(max(action, -1.0), 1.0)
    low, high = settings[6:{high_start}], settings[{high_start}:]
    {state} = {state_of_row}
    {state}, inside = integrate({arguments}, u, dt / substeps, substeps, low, high)
    {state_of_row} = {state}
    row[{clock}] += 1.0
    clock = row[{clock}]
    observe(row, clock * dt, observation)
    error = observation[{output}] - observation[{reference_start}]
    remaining = 0.0 if inside else steps - clock
    gain = reward(cost(error, u, settings[5]), settings[4], dt, remaining)
    return gain, not inside, inside and clock >= steps


@njit(cache=True, nogil=True)
def first_observation(row):
    """The observation at time 0."""
    observation = np.empty({size})
    observe(row, 0.0, observation)
    return observation


@njit(cache=True, nogil=True)
def advance_one(row, action, settings):
    """The scalar environment's step: (observation, reward, terminated, truncated)."""
    observation = np.empty({size})
    gain, terminated, truncated = advance(row, action, settings, observation)
    return observation, gain, terminated, truncated


@njit(cache=True, nogil=True)
def advance_all(rows, actions, settings, active, observations, rewards, terminated, truncated, start, stop):
    """The vector environment's step of the rows start to stop; rows that are not active are left alone."""
    for i in range(start, stop):
        if active[i]:
            rewards[i], terminated[i], truncated[i] = advance(rows[i], actions[i, 0], settings, observations[i])
'''


def load(plant: Plant, reference: Reference, cost: str) -> ModuleType:
    """The compiled step of this plant, reference family and cost."""
    n, p, r = plant.order, len(plant.theta), len(reference.defaults)
    name = reference.derivatives.__name__
    state = [f"x{i + 1}" for i in range(n)]
    source = TEMPLATE.format(
        name=plant.name,
        reference=name,
        cost=cost,
        plant=plant.kernel.__name__,
        state=", ".join(state),
        state_of_row=", ".join(f"row[{i}]" for i in range(n)),
        arguments=", ".join([*state, *(f"row[{n + i}]" for i in range(p))]),
        observed_state=", ".join(f"observation[{i}]" for i in range(n)),
        observed_derivatives=", ".join(f"observation[{n + i}]" for i in range(n)),
        output=n,
        reference_slice=f"{n + p}:{n + p + r}",
        reference_start=2 * n,
        high_start=6 + n,
        clock=n + p + r,
        size=3 * n + 1,
    )
    hashed = kernels.key(source, kernels.fingerprint(*kernels.files("mfc_gym", "references", "reward")))
    return kernels.load(f"mfc_step_{hashed}", lambda: source)
