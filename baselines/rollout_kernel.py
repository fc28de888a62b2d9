"""Whole episodes compiled: the environment's step and a redesign law in one loop, the same numbers as step by step."""

from types import ModuleType

from baselines.redesign import LyapunovRedesign
from mfc_gym import kernels

TEMPLATE = '''"""Generated: episodes of a redesign law in its environment. Do not edit."""

import numpy as np
from numba import njit

from {law} import control
from {step} import advance, output


@njit(cache=True, nogil=True)
def run(rows, settings, memory, law, observations, outputs, controls, rewards, terminated, start, stop):
    """Episodes start to stop from their first observations (B, N+1, 3n+1) on; what follows an episode's end stays as it is."""
    limit = settings[2]
    for i in range(start, stop):
        for k in range(controls.shape[1]):
            action = control(observations[i, k], memory[i], k == 0, law) / limit
            controls[i, k] = limit * min(max(action, -1.0), 1.0)
            rewards[i, k], terminated[i], truncated = advance(rows[i], action, settings, observations[i, k + 1])
            outputs[i, k + 1] = output(rows[i])
            if terminated[i] or truncated:
                break
'''


def load(step: ModuleType, controller: LyapunovRedesign) -> ModuleType:
    """The compiled loop of this environment step and this law."""
    source = TEMPLATE.format(law=controller.kernel.__name__, step=step.__name__)
    return kernels.load(f"mfc_run_{kernels.key(source)}", lambda: source)
