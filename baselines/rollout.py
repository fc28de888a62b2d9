"""One episode, or one batch of episodes, of a policy in an environment."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from numpy.typing import NDArray

from baselines import rollout_kernel
from baselines.controller import Controller
from baselines.redesign import LyapunovRedesign
from baselines.trajectory import Trajectory
from mfc_gym import observation as layout
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]
Batch = tuple[Array, Array, Array, Array, NDArray[np.bool_]]  # observations, outputs, controls, rewards, terminated


def rollout(
    env: Any, policy: Any, seed: int | None = None, options: dict[str, Any] | None = None, compiled: bool = True
) -> Trajectory:
    """Run `policy` (anything with Stable-Baselines3's `predict`) for one episode of `env`.

    A vector environment gives a batch, one more axis after time; what follows an episode's end is NaN there. A controller of
    the redesign family in an environment without further wrappers runs as one compiled loop, with the same numbers. Raises
    ValueError for an environment of another kind, and for a controller made for another bound of the input.
    """
    nominal = getattr(env.unwrapped, "nominal", None)
    if not isinstance(nominal, NominalModel):
        raise ValueError(
            "`env` must be an environment of mfc_gym, or a vector of them made with vectorization_mode='vector_entry_point', "
            f"got {env}."
        )
    if isinstance(policy, Controller):
        require_limit(policy, nominal.input_limit)
    observation, _ = env.reset(seed=seed, options=options)
    batch = hasattr(env, "num_envs")
    fits = isinstance(policy, LyapunovRedesign) and policy.nominal.order == nominal.order  # else `predict` says so
    if compiled and fits and _plain(env):
        found = _compiled(env.unwrapped, policy, np.atleast_2d(observation))
    else:
        found = _stepwise(env, policy, observation, batch)
    observations, outputs, controls, rewards, terminated = found
    if not batch:
        observations, outputs, controls, rewards = observations[:, 0], outputs[:, 0], controls[:, 0], rewards[:, 0]
    return Trajectory(
        time=env.unwrapped.dt * np.arange(len(observations)),
        state=layout.state(observations),
        output_derivatives=layout.output_derivatives(observations),
        reference=layout.reference(observations),
        control=controls,
        reward=rewards,
        terminated=terminated if batch else bool(terminated[0]),
        output=outputs,
    )


def require_limit(controller: Controller, limit: float) -> None:
    """Raises ValueError if the controller's actions mean another input here."""
    if controller.nominal.input_limit != limit:
        raise ValueError(
            f"`controller` must be made for this environment's input_limit {limit}, got one for {controller.nominal.input_limit}."
        )


def _plain(env: Any) -> bool:
    """Whether nothing between the environment and the policy changes what they exchange."""
    while isinstance(env, (OrderEnforcing, PassiveEnvChecker)):
        env = env.env
    return env is env.unwrapped and hasattr(env, "rows")


def _compiled(env: Any, controller: LyapunovRedesign, first: Array) -> Batch:
    simulation, rows = env.simulation, env.rows
    count, steps = len(first), simulation.steps
    observations = np.full((count, steps + 1, first.shape[1]), np.nan)
    observations[:, 0] = first
    outputs = np.full((count, steps + 1), np.nan)
    outputs[:, 0] = env.output
    controls, rewards = np.full((count, steps), np.nan), np.full((count, steps), np.nan)
    terminated = np.zeros(count, dtype=bool)
    memory = controller.first_memory(first)
    run = rollout_kernel.load(simulation.kernel, controller).run

    shared = (simulation.settings, memory, controller.law, simulation.table(rows))

    def chunk(start: int, stop: int) -> None:
        run(rows, *shared, observations, outputs, controls, rewards, terminated, start, stop)

    threads = min(count, os.cpu_count() or 1)
    edges = np.linspace(0, count, threads + 1).astype(int)
    if threads == 1:
        chunk(0, count)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(chunk, edges[:-1], edges[1:]))
    longest = int((~np.isnan(rewards)).any(axis=0).sum())
    samples = [np.moveaxis(a[:, : longest + 1], 0, 1) for a in (observations, outputs)]
    steps_taken = [np.moveaxis(a[:, :longest], 0, 1) for a in (controls, rewards)]
    return samples[0], samples[1], steps_taken[0], steps_taken[1], terminated


def _stepwise(env: Any, policy: Any, observation: Array, batch: bool) -> Batch:
    state: Any = None
    start: Any = np.ones(len(observation), dtype=bool) if batch else None
    running = np.ones(len(observation) if batch else 1, dtype=bool)
    terminated_at_all = np.zeros_like(running)
    limit = env.unwrapped.nominal.input_limit
    same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
    observations, outputs, controls, rewards = (
        [np.atleast_2d(observation)],
        [np.atleast_1d(env.unwrapped.output)],
        [],
        [],
    )
    while running.any():
        action, state = policy.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
        start = np.zeros_like(start) if batch else None
        applied = limit * np.clip(np.asarray(action, dtype=float)[..., 0], -1.0, 1.0)
        reached = _reached(observation, info)
        observations.append(np.where(running[:, None], reached, np.nan))
        controls.append(np.where(running, applied, np.nan))
        rewards.append(np.where(running, np.asarray(reward), np.nan))
        terminated_at_all |= running & terminated
        ended = np.asarray(terminated) | np.asarray(truncated)
        true = np.where(ended, env.unwrapped.final_output, env.unwrapped.output) if same_step else env.unwrapped.output
        outputs.append(np.where(running, true, np.nan))
        running = running & ~ended
        if ended.any() and running.any() and env.metadata.get("autoreset_mode") == AutoresetMode.DISABLED:
            observation, _ = env.reset(options={"reset_mask": ended})
    return np.array(observations), np.array(outputs), np.array(controls), np.array(rewards), terminated_at_all


def _reached(observation: Array, info: dict[str, Any]) -> Array:
    """The observations a step ended with, shape (B, 3n+1), also where the next episode has begun in the same step."""
    reached = np.array(np.atleast_2d(observation))
    for i in np.flatnonzero(info.get("_final_obs", False)):
        reached[i] = info["final_obs"][i]
    return reached
