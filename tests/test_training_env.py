"""What a learner sees: constants of the plant, rewards whose discounted sum is bounded."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from baselines.agents import make_vec_env
from baselines.interface import Interface
from baselines.observer import Observer
from baselines.training_env import BORDER, ESCAPE, INNER, VALUES, TrainingEnv, features, shape, widths

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


def test_past_frames_are_seen_as_backward_differences() -> None:
    """That of order k is blind to polynomials of degree below k in time, and not to degree k."""
    d, past = 10, 3
    interface = Interface(Observer(last_action=True, past=past, dt=0.05))
    seen = features(ENV, OPTIONS, 0, interface)
    frame, start = d + 1, d + 3 + 1  # after [x, xi_n, y_d ..., e, last action]
    assert seen.offset.size == start + past * frame
    for degree in range(past + 1):
        moments = -(np.arange(past + 1.0) ** degree) if degree else np.ones(past + 1)
        signals = np.repeat(moments, frame)
        for order in range(1, past + 1):
            rows = slice(start + (order - 1) * frame, start + order * frame)
            left = np.abs(seen.matrix[rows] @ signals) / np.abs(seen.matrix[rows]).max(axis=1)
            assert (left < 1e-12).all() if order > degree else (left > 0.1).all() or degree > order


def test_fading_is_in_units_of_the_reference_errors() -> None:
    """Widths are the deviations by which the features divide e."""
    seen = features(ENV, OPTIONS, 0)
    assert np.allclose(widths(seen, Interface(), 3) * np.abs(seen.matrix[10:13]).max(axis=1), 1.0, rtol=1e-14, atol=0)
