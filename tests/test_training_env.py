"""What a learner sees: constants of the plant, rewards whose discounted sum is bounded."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from baselines.agents import make_vec_env
from baselines.training_env import VALUES, TrainingEnv, features

ENV, GAMMA = "mfc_gym/PerturbedChain-v0", 0.98
OPTIONS = {"scenario": "random", "dt": 0.05, "horizon": 2.0}


@pytest.fixture
def env() -> TrainingEnv:
    venv = make_vec_env(ENV, 8, seed=0, **OPTIONS)
    return TrainingEnv(venv, features(ENV, OPTIONS, 0), GAMMA, venv.get_attr("simulation")[0])


def test_features_are_observation_and_error_to_scale(env: TrainingEnv) -> None:
    """The last n are (xi_n - xi_d - mean) / deviation."""
    seen, n = env.features, 3
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(50, 3 * n + 1))
    raw = (seen(observations) - seen.offset) / np.abs(seen.matrix).max(axis=1)
    assert np.allclose(raw[:, : 3 * n + 1], observations, rtol=0, atol=1e-12)
    error = observations[:, n : 2 * n] - observations[:, 2 * n : 3 * n]
    assert np.allclose(raw[:, 3 * n + 1 :], error, rtol=0, atol=1e-12)


def test_features_are_constants(env: TrainingEnv) -> None:
    """The same from the same seed, and of order one where the episodes begin."""
    again = features(ENV, OPTIONS, 0)
    assert np.array_equal(again.matrix, env.features.matrix)
    assert np.array_equal(again.offset, env.features.offset)
    assert 0.1 < np.abs(env.reset()).mean() < 10


def test_no_return_is_worse_than_the_largest_cost_for_ever(env: TrainingEnv) -> None:
    """Also where an episode leaves the region, which pays cost_max for the rest of the horizon at once."""
    env.reset()
    total, ended = np.zeros(8), np.zeros(8, dtype=bool)
    for k in range(40):
        _, rewards, dones, infos = env.step(np.ones((8, 1)))
        assert (rewards <= 0).all()
        total += np.where(ended, 0.0, GAMMA**k * rewards)
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"].shape == (13,)
        ended |= dones
    assert ended.all()
    assert (total >= -VALUES * (1 + 1e-6)).all()
    assert total.min() < -VALUES / 4


def test_the_reward_is_a_logarithm_of_the_cost(env: TrainingEnv) -> None:
    """0 for none, -VALUES (1 - gamma) for cost_max, and half of what is between them where 1 + cost / precision is the root."""
    root = env.precision * (np.sqrt(1 + env.cost_max / env.precision) - 1)
    paid = env._paid(-env.dt * np.array([0.0, root, env.cost_max], dtype=np.float32))
    assert np.allclose(paid, -VALUES * (1 - GAMMA) * np.array([0.0, 0.5, 1.0]), rtol=0, atol=1e-6)
