"""The native VecEnv for Stable-Baselines3 against its own DummyVecEnv over scalar environments."""

import importlib
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import baselines

stable_baselines3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize  # noqa: E402

from baselines import agents  # noqa: E402

ID = "mfc_gym/PerturbedChain-v0"
SHORT = {"dt": 0.05, "horizon": 1.0}
CASES = {
    "paper": {},
    "random": {"scenario": "random"},
    "order 2": {"scenario": "random", "order": 2, "reference": "chirp", "cost": "quadratic"},
    "sensors": {
        "scenario": "random",
        "derivatives": "ired",
        "sensors": {"noise": 0.01, "state_noise": 0.01, "distribution": "gaussian", "dropout": 0.1, "delay": 2},
    },
}


def native(num_envs, seed=None, **options):
    return agents.make_vec_env(ID, num_envs, seed, **{**SHORT, **options})


def dummy(num_envs, seed=None, **options):
    env = DummyVecEnv([lambda: gym.make(ID, **{**SHORT, **options}) for _ in range(num_envs)])
    if seed is not None:
        env.seed(seed)
    return env


def same(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def pushes(rng, steps, num_envs):
    """Actions, some out of range, that drive some environments out of the region, each at its own time."""
    strength = rng.choice([0.02, 0.3, 1.5], num_envs)
    return strength[:, None] * rng.uniform(-0.5, 1.0, (steps, num_envs, 1)).astype(np.float32)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [0, 9])
@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, VecNormalize])
def test_equals_dummy_vec_env_step_by_step(case, seed, wrap):
    a, b = wrap(native(5, seed, **CASES[case])), wrap(dummy(5, seed, **CASES[case]))
    assert a.observation_space == b.observation_space
    assert a.action_space == b.action_space
    assert same(a.reset(), b.reset())
    assert a.reset_infos == b.reset_infos
    ends = {True: 0, False: 0}
    for actions in pushes(np.random.default_rng(seed), 90, 5):
        (*arrays, infos), (*expected, expected_infos) = a.step(actions), b.step(actions)
        assert all(same(x, y) for x, y in zip(arrays, expected, strict=True))
        for info, expected_info, done in zip(infos, expected_infos, arrays[2], strict=True):
            if "episode" in info:
                del info["episode"]["t"], expected_info["episode"]["t"]  # seconds since the start
            assert data_equivalence(info, expected_info)
            if done:
                ends[info["TimeLimit.truncated"]] += 1
                assert isinstance(info["is_success"], bool)
        assert a.reset_infos == b.reset_infos
    assert min(ends.values()) > 2, f"too few truncated, terminated: {ends}"
    assert same(a.reset(), b.reset())  # the streams go on


def test_options_are_used_once():
    a, b = native(3, 0, scenario="random"), dummy(3, 0, scenario="random")
    each = [{"initial_state": [0.1, 0, 0]}, {}, {"reference_parameters": {"amplitude": 0.25}}]
    for options in ({"theta": [0.1, -0.1]}, each, None):
        for env in (a, b):
            env.seed(3)
            env.set_options(options)
        assert same(a.reset(), b.reset())
    assert same(a.reset(), b.reset())


def test_infos_are_nobody_elses():
    """Writing into the infos of one step, or of one environment, shows nowhere else."""
    env = native(2, 0)
    env.reset()
    infos = env.step(np.zeros((2, 1)))[3]
    infos[0]["mine"] = 1
    assert infos[1] == {"TimeLimit.truncated": False}
    assert env.step(np.zeros((2, 1)))[3] == [{"TimeLimit.truncated": False}] * 2


def test_attributes():
    a, b = native(3, 0, scenario="random"), dummy(3, 0, scenario="random")
    a.reset()
    b.reset()
    for name in ("theta", "reference_parameters"):
        assert all(same(x, y) for x, y in zip(a.get_attr(name), b.get_attr(name), strict=True))
        assert same(a.get_attr(name, 1)[0], b.get_attr(name, [1])[0])
        assert same(a.env_method("get_wrapper_attr", name, indices=[2])[0], b.get_attr(name, 2)[0])
    for name in ("dt", "render_mode", "action_space", "observation_space"):
        assert a.get_attr(name, [0, 2]) == b.get_attr(name, [0, 2])
    assert a.get_attr("np_random_seed") == b.get_attr("np_random_seed")
    assert not a.has_attr("action_masks")
    assert a.env_is_wrapped(Monitor, [0, 1]) == [False, False]
    assert a.spec.id == ID
    a.set_attr("lesson", 3)
    assert a.get_attr("lesson") == [3, 3, 3]
    with pytest.raises(ValueError, match="the environments share 'lesson', got 1"):
        a.set_attr("lesson", 4, 1)
    with pytest.raises(AttributeError, match="no method 'action_masks'"):
        a.env_method("action_masks")
    a.close()
    assert a.envs.closed


def test_needs_resets_in_the_same_step():
    envs = gym.make_vec(ID, 2, vectorization_mode="vector_entry_point")
    with pytest.raises(ValueError, match=r"`envs` must have AutoresetMode.SAME_STEP, got AutoresetMode.NEXT_STEP"):
        agents.NativeVecEnv(envs)
    assert native(1).envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_evaluates_controllers_and_trains_agents():
    """Stable-Baselines3's own evaluation gives the return of a rollout, and PPO learns in it without a complaint."""
    env = VecMonitor(native(3, 0))
    controller = baselines.make("mfc", env.unwrapped.envs)
    mean, deviation = evaluate_policy(controller, env, n_eval_episodes=3)
    single = baselines.rollout(gym.make(ID, **SHORT), controller, seed=0)
    assert mean == pytest.approx(single.reward.sum(), rel=1e-6)  # VecMonitor adds in float32
    assert deviation == pytest.approx(0.0, abs=1e-6)
    model = stable_baselines3.PPO("MlpPolicy", VecNormalize(env), n_steps=32, batch_size=32, n_epochs=1, seed=0)
    model.learn(192)
    assert model.num_timesteps == 192
    assert len(model.ep_info_buffer) > 0


def test_without_stable_baselines3(monkeypatch):
    monkeypatch.delitem(sys.modules, "baselines.agents")
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with pytest.raises(gym.error.DependencyNotInstalled, match="pip install"):
        importlib.import_module("baselines.agents")
