"""One episode, or one batch of episodes, of a policy in an environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.trajectory import Trajectory
from mfc_gym import observation as layout

Array = NDArray[np.float64]


def rollout(env: Any, policy: Any, seed: int | None = None, options: dict[str, Any] | None = None) -> Trajectory:
    """Run `policy` (anything with Stable-Baselines3's `predict`) for one episode of `env`.

    A vector environment gives a batch, one more axis after time; what follows an episode's end is NaN there.
    """
    batch = hasattr(env, "num_envs")
    observation, _ = env.reset(seed=seed, options=options)
    state: Any = None
    start: Any = np.ones(observation.shape[0], dtype=bool) if batch else None
    observations, controls, rewards = [observation], [], []
    running = np.ones(observation.shape[:-1], dtype=bool)
    terminated_at_all = np.zeros_like(running)
    limit = env.unwrapped.nominal.input_limit
    while running.any():
        action, state = policy.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        start = np.zeros_like(start) if batch else None
        applied = limit * np.clip(np.asarray(action, dtype=float)[..., 0], -1.0, 1.0)
        observations.append(np.where(running[..., None], observation, np.nan))
        controls.append(np.where(running, applied, np.nan))
        rewards.append(np.where(running, reward, np.nan))
        terminated_at_all |= running & terminated
        running = running & ~(np.asarray(terminated) | np.asarray(truncated))
    history = np.array(observations)
    return Trajectory(
        time=env.unwrapped.dt * np.arange(len(history)),
        state=layout.state(history),
        output_derivatives=layout.output_derivatives(history),
        reference=layout.reference(history),
        control=np.array(controls),
        reward=np.array(rewards),
        terminated=terminated_at_all if batch else bool(terminated_at_all),
    )
