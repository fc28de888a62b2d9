"""What a learner sees: constants of the plant, rewards whose discounted sum is bounded."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from baselines.agents import make_vec_env
from baselines.training_env import BORDER, ESCAPE, INNER, VALUES, TrainingEnv, features, shape

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


def test_discounted_sums_are_bounded(env: TrainingEnv) -> None:
    """By the largest cost for ever, and by ESCAPE after it where an episode leaves the region."""
    env.reset()
    total, ended = np.zeros(8), np.zeros(8, dtype=bool)
    for k in range(40):
        _, rewards, dones, infos = env.step(np.ones((8, 1)))
        assert ((rewards <= 0) & ((rewards >= -VALUES * (1 - GAMMA) * (1 + BORDER)) | (rewards == -ESCAPE))).all()
        total += np.where(ended, 0.0, GAMMA**k * rewards)
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"].shape == (13,)
        ended |= dones
    assert ended.all()
    assert (total >= -(VALUES * (1 + BORDER) + ESCAPE)).all()
    assert total.min() < -ESCAPE / 2


def test_the_shape_is_zero_and_monotone() -> None:
    z = np.linspace(0.0, 200.0, 1000)
    assert shape(z)[0] == 0.0
    assert (np.diff(shape(z)) > 0).all()


def test_the_reward_ends_at_the_largest_cost(env: TrainingEnv) -> None:
    """0 for no cost, -VALUES (1 - gamma) for cost_max, -ESCAPE for what is charged beyond."""
    paid = env._paid(-env.dt * np.array([0.0, env.cost_max, 5 * env.cost_max], dtype=np.float32), np.zeros((3, 3)))
    assert np.allclose(paid, [0.0, -VALUES * (1 - GAMMA), -ESCAPE], rtol=1e-6, atol=0)


def test_the_border_costs_before_it_is_crossed(env: TrainingEnv) -> None:
    """Nothing up to INNER of the half width, BORDER times the largest cost at the border."""
    x = env.middle + np.array([[0.0], [INNER], [1.0]]) * env.half
    paid = env._paid(np.zeros(3, dtype=np.float32), x)
    assert np.allclose(paid, -VALUES * (1 - GAMMA) * BORDER * np.array([0.0, 0.0, 1.0]), rtol=1e-6, atol=1e-12)
