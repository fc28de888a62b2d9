"""What `import mfc_gym` costs and leaves alone. Each test is a new process."""

import subprocess
import sys
from collections.abc import Callable

import gymnasium as gym

import mfc_gym
from mfc_gym.env import TrackingEnv
from mfc_gym.systems import SYSTEMS


def run(script: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True, timeout=300
    ).stdout


def test_import_loads_little() -> None:
    script = "import sys, mfc_gym; print([m for m in ('torch', 'matplotlib', 'sympy', 'numba') if m in sys.modules])"
    assert run(script) == "[]\n"


def test_import_changes_no_global_state() -> None:
    """NumPy's error state and print options, warning filters and both random generators; Gymnasium's own import aside."""
    script = """
import random, warnings, numpy as np, gymnasium
def state():
    return (np.geterr(), np.get_printoptions(), list(warnings.filters), random.getstate(),
            [part.tolist() if hasattr(part, "tolist") else part for part in np.random.get_state()])
before = state()
import mfc_gym
print(state() == before)
env = gymnasium.make("mfc_gym/PerturbedChain-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
after = state()
print([a == b for a, b in zip(before, after)])
"""
    assert run(script) == "True\n[True, True, True, True, True]\n"


def test_a_cached_plant_needs_no_sympy(make: Callable[..., TrackingEnv]) -> None:
    make().reset(seed=0)  # now the cache is warm
    script = """
import sys, gymnasium as gym, mfc_gym
env = gym.make("mfc_gym/PerturbedChain-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
print([m for m in ("sympy", "matplotlib", "torch") if m in sys.modules])
"""
    assert run(script) == "[]\n"


def test_names_are_registered() -> None:
    """Every plant has an id; `module:id` imports the package by itself."""
    assert tuple(f"mfc_gym/{name}-v0" for name in SYSTEMS) == mfc_gym.ENV_IDS
    for env_id in mfc_gym.ENV_IDS:
        assert gym.spec(env_id).max_episode_steps is None  # the environment owns its clock
    script = "import gymnasium as gym; print(gym.make('mfc_gym:mfc_gym/PerturbedChain-v0').unwrapped.dt)"
    assert run(script) == "0.01\n"
