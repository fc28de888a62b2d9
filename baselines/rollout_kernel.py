"""Whole episodes compiled: the environment's step and a redesign law in one loop, the same numbers as step by step."""

from types import ModuleType

from baselines.redesign import LyapunovRedesign
from mfc_gym import kernels

BLOCK = 128  # episodes side by side: their integrations fill the processor, one alone waits for its own last result

TEMPLATE = '''"""Generated: episodes of a redesign law in its environment. Do not edit."""

import numpy as np
from numba import njit

from {law} import control
from {step} import advance_all, output


@njit(cache=True, nogil=True)
def run(rows, settings, memory, law, table, observations, outputs, controls, rewards, terminated, start, stop):
    """Episodes start to stop from their first observations (B, N+1, 3n+1) on; what follows an episode's end stays as it is."""
    limit, work, none = settings[2], np.empty({work}), np.empty(0)
    for first in range(start, stop, {block}):
        count = min({block}, stop - first)
        columns, seen = np.empty((rows.shape[1], count)), np.empty((count, observations.shape[2]))
        columns[:], seen[:] = rows[first : first + count].T, observations[first : first + count, 0]
        actions, gains, active = np.empty(count), np.empty(count), np.ones(count, np.bool_)
        ends = np.empty((2, count), np.bool_)
        for k in range(controls.shape[1]):
            for j in range(count):
                if active[j]:
                    actions[j] = control(seen[j], memory[first + j], k == 0, law) / limit
                    controls[first + j, k] = limit * min(max(actions[j], -1.0), 1.0)
            advance_all(
                columns, settings, active, none, actions, work, 0, count, table, seen, gains, ends
            )
            for j in range(count):
                if active[j]:
                    i = first + j
                    for m in range(seen.shape[1]):
                        observations[i, k + 1, m] = seen[j, m]
                    outputs[i, k + 1] = output(columns[:, j])
                    rewards[i, k], terminated[i] = gains[j], ends[0, j]
                    active[j] = not (ends[0, j] or ends[1, j])
            if not active.any():
                break
        rows[first : first + count] = columns.T
'''


def load(step: ModuleType, controller: LyapunovRedesign) -> ModuleType:
    """The compiled loop of this environment step and this law."""
    source = TEMPLATE.format(law=controller.kernel.__name__, step=step.__name__, block=BLOCK, work=step.WORK)
    return kernels.load(f"mfc_run_{kernels.key(source)}", lambda: source)
