"""Plants of one's own from Python."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils.env_checker import check_env

import baselines
import mfc_gym
from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task

x1, x2, eps = sp.symbols("x1 x2 eps", real=True)
PENDULUM = FlatSystem(
    name="pendulum on a slipping shaft",
    state=("x1", "x2"),
    f=(x2, -sp.sin(x1)),
    g=(0, 1),
    h=x1,
    Delta=(eps * x2, 0),
    theta={"eps": (-0.3, 0.3)},
    region={"x1": (-4, 4), "x2": (-6, 6)},
    task=Task(theta=(0.2,), initial_state=(0.5, 0.0), input_limit=20.0),
)


def test_a_registered_plant_runs() -> None:
    """Its bounds are derived, its id works everywhere, and registering it again changes nothing."""
    env_id = mfc_gym.register_system("SlippingPendulum", PENDULUM)
    assert env_id == mfc_gym.register_system("SlippingPendulum", PENDULUM) == "mfc_gym/SlippingPendulum-v0"
    env = gym.make(env_id)
    check_env(env.unwrapped)
    trajectory = baselines.rollout(env, baselines.make("mfc", env), seed=0)
    assert np.abs(trajectory.error[1000:]).max() < 1e-4
    assert float(env.unwrapped.nominal.delta_3(np.zeros(2))) == pytest.approx(0.3)
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode="vector_entry_point")
    np.testing.assert_array_equal(envs.reset(seed=0)[0][0], env.reset(seed=0)[0])


def test_a_name_stands_for_one_plant() -> None:
    mfc_gym.register_system("SlippingPendulum", PENDULUM)
    with pytest.raises(ValueError, match="`name` must be new, 'SlippingPendulum' is another plant already"):
        mfc_gym.register_system("SlippingPendulum", replace(PENDULUM, theta={"eps": (-0.2, 0.2)}))


@pytest.mark.parametrize(
    ("name", "system", "message"),
    [
        ("Chua", PENDULUM, "`name` must not be that of a plant of the library"),
        ("my plant", PENDULUM, "`name` must be a letter followed by"),
        (
            "TooUncertain",
            replace(PENDULUM, theta={"eps": (-1.2, 0.2)}, task=Task()),
            r"`theta` must keep abs\(Delta_3\) < 1",
        ),
        ("TooSmall", replace(PENDULUM, bounds={"delta_1": 0.01, "delta_3": 0.3}), "`bounds` delta_1 must bound"),
        ("Pole", replace(PENDULUM, f=(x2, 1 / x1)), "`f` entry 2 must be defined in the whole operating region"),
    ],
)
def test_refused(name: str, system: FlatSystem, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mfc_gym.register_system(name, system)
