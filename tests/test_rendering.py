"""Pictures without a display."""

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest

from mfc_gym.env import TrackingEnv


def episode(env: TrackingEnv, steps: int) -> None:
    env.reset(seed=0)
    for k in range(steps):
        env.step(np.array([np.sin(k)], np.float32))


def test_a_picture(make: Callable[..., TrackingEnv]) -> None:
    """An RGB array of its own that shows the episode: the same one looks the same, a longer one does not."""
    env = make(render_mode="rgb_array")
    episode(env, 20)
    first, again = env.render(), env.render()
    assert first.dtype == np.uint8
    assert first.shape == (480, 640, 3)
    assert first.min() < 100 < 250 < first.max()
    np.testing.assert_array_equal(first, again)
    assert not np.shares_memory(first, again)
    episode(env, 40)
    assert (env.render() != first).any()
    episode(env, 20)
    np.testing.assert_array_equal(env.render(), first)


def test_what_is_drawn_is_what_was(make: Callable[..., TrackingEnv]) -> None:
    """An observation or action that the caller overwrites does not change the picture."""
    pictures = []
    for overwrite in (False, True):
        env = make(render_mode="rgb_array")
        observation, _ = env.reset(seed=0)
        for _ in range(20):
            action = np.array([0.5], np.float32)
            if overwrite:
                observation[:] = 0.0
            observation = env.step(action)[0]
            action[:] = 0.0
        pictures.append(env.render())
    np.testing.assert_array_equal(*pictures)


def test_before_reset(make: Callable[..., TrackingEnv]) -> None:
    """The plain environment shows empty axes, the wrapped one says what is missing."""
    picture = make(render_mode="rgb_array").render()
    assert picture.shape == (480, 640, 3)
    with pytest.raises(gym.error.ResetNeeded):
        gym.make("mfc_gym/PerturbedChain-v0", render_mode="rgb_array").render()


def test_nothing_is_recorded_unless_asked_for(make: Callable[..., TrackingEnv]) -> None:
    env = make()
    episode(env, 3)
    assert env.render() is None
    assert env._recorder is None


@pytest.mark.parametrize("mode", ["human", "ansi", 3])
def test_unknown_mode(mode: object) -> None:
    with pytest.raises(ValueError, match=r"`render_mode` must be one of \['rgb_array'\], got"):
        TrackingEnv(render_mode=mode)


def test_declared() -> None:
    assert TrackingEnv.metadata["render_modes"] == ["rgb_array"]
    assert TrackingEnv.metadata["render_fps"] > 0
