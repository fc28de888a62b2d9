"""The compiled step's measurement: x and xi_n known exactly, or through sensors and a differentiator.

With sensors, the step's settings go on with [noise, state_noise, quantisation, dropout, settings of the differentiator, low and
high of what x and xi_n can read (4n)], and an episode's row has a sensor memory, [key, last y received, last x (n), last xi_n
(n), the delayed samples (delay (n+1))]; a y that is NaN: nothing measured yet.
"""

from mfc_gym.sensors import Sensors

IDEAL = {
    "sensing": "",
    "observe_plant": """{observed_state} = {state}
    {observed_derivatives} = output_derivatives({arguments})""",
    "observe_step": "observe_plant(row, settings, observation)",
    "observe_block": """{observed_states} = {state_of_block}
            {observed_derivatives_of_block} = output_derivatives({block_arguments})""",
    "output_of_block": "observations[i, {output}]",
}

SENSED = {
    "sensing": """from mfc_gym.differentiators import bound_from_input
from mfc_gym.differentiators import {differentiator} as differentiate
from mfc_gym.sensors import DROPOUT, OUTPUT, STATE, quantised, random
from mfc_gym.sensors import {distribution} as noise
from {nominal} import bounds, coordinates, lie_terms


@njit
def read(memory, observation):
    # [x, xi_n] as last measured
    for i in range(2 * {n}):
        observation[i] = memory[2 + i]


@njit
def sense(memory, {state}, y, u, sample, settings, observation):
    # measures x and y, steps the differentiator, writes [x, xi_n]; u acted over the last interval
    key = memory[0]
    received = quantised(y + settings[{sensors}] * noise(key, sample, OUTPUT), settings[{sensors} + 2])
    if sample > 0.0 and random(key, sample, DROPOUT) < settings[{sensors} + 3]:
        received = memory[1]
    memory[1] = received
    for i, value in enumerate(({state})):
        observation[i] = value + settings[{sensors} + 1] * noise(key, sample, STATE + i)
    if {delay} > 0:
        for k in range({delay}):
            slot = {ring} + k * {n1}
            if sample == 0.0 or k == int(sample) % {delay}:
                before = memory[slot + {n}]
                memory[slot + {n}] = received
                if sample > 0.0:
                    received = before
                for i in range({n}):
                    before = memory[slot + i]
                    memory[slot + i] = observation[i]
                    if sample > 0.0:
                        observation[i] = before
    {state} = {observed_state}
    if sample > 0.0:
        alpha, beta = lie_terms({state})
        known = bounds({state})
        bound = bound_from_input(alpha, beta * u, known[0], known[1], {floor} * abs(beta) * settings[2])
        tuning = settings[{sensors} + 4 :]
        differentiate(memory[{estimate}:{ring}], received, bound, settings[0], tuning, observation[{n} : {n2}])
    elif np.isnan(memory[{estimate}]):
        {observed_derivatives} = coordinates({state})
    else:
        for i in range({n}):
            observation[{n} + i] = memory[{estimate} + i]
    for i in range(2 * {n}):  # what is beyond a sensor's range reads as its end
        observation[i] = min(max(observation[i], settings[{ranges} + i]), settings[{ranges} + 2 * {n} + i])
        memory[2 + i] = observation[i]
""",
    "observe_plant": """memory = row[{sensor_start}:{clock}]
    if np.isnan(memory[1]):
        sense(memory, {state}, output(row), 0.0, 0.0, settings, observation)
    else:
        read(memory, observation)""",
    "observe_step": "sense(row[{sensor_start}:{clock}], {state}, output(row), u, row[{clock}], settings, observation)",
    "observe_block": """memory = columns[{sensor_start}:{clock}, i]
            if active[i] or np.isnan(memory[1]):
                y = output_derivatives({block_arguments})[0]
                sense(memory, {state_of_block}, y, u[j], columns[{clock}, i], settings, observations[i])
            else:
                read(memory, observations[i])""",
    "output_of_block": "output_derivatives({block_arguments})[0]",
}

FLOOR = 0.1  # of the largest y^(n) that the input can ask for: smallest bound of the differentiator


def sensor_memory(n: int, sensors: Sensors | None) -> int:
    """Numbers of sensor memory per episode, m."""
    return 0 if sensors is None else 2 + 2 * n + sensors.delay * (n + 1)
