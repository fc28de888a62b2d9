"""Behaviour cloning: an actor's mean regressed on what a controller of the registry does, states after mistakes among them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from baselines.interface import Interface
from baselines.residual import Base

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cloning:
    """How much is recorded and how long the regression goes on."""

    episodes: int = 256
    noise: float = 0.1  # largest amplitude of what is added to the actions, in actions; drawn for each episode
    hold: float = 0.1  # s, mean time for which it stays the same
    updates: int = 12_000
    batch: int = 1024
    learning_rate: float = 2e-3  # at the start; it falls to zero along a cosine


def record(
    id: str, options: Mapping[str, Any], base: Base, interface: Interface, seed: int, given: Cloning
) -> tuple[Array, Array]:
    """(signals (M, s), actions (M,)): what the interface sees of disturbed episodes, and what the controller does there."""
    mode, count = AutoresetMode.SAME_STEP, given.episodes
    envs: Any = gym.make_vec(id, count, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options)
    controller, interface = base.build(envs.unwrapped.nominal), interface.made_for(envs)
    rng = np.random.default_rng(seed)
    observations, _ = envs.reset(seed=seed)
    memory = np.zeros((count, interface.memory_size(observations.shape[1])))
    fresh, state, disturbance = np.ones(count, dtype=bool), None, np.zeros(count)
    amplitude = given.noise * rng.uniform(0.0, 1.0, count) ** 2
    signals, actions = [], []
    for _ in range(envs.unwrapped.simulation.steps):
        seen, held = interface.see(observations, memory, fresh)
        action, state = controller.predict(observations, state, fresh)
        changed = rng.uniform(size=count) < envs.unwrapped.dt / given.hold
        disturbance = np.where(changed, amplitude * rng.uniform(-1.0, 1.0, count), disturbance)
        signals.append(seen)
        actions.append(action[:, 0])
        applied = interface.act(action + disturbance[:, None], held, memory)
        observations, _, terminated, truncated, _ = envs.step(applied)
        fresh = terminated | truncated
    envs.close()
    return np.concatenate(signals), np.concatenate(actions)


def clone(model: Any, seen: Array, actions: Array, seed: int, given: Cloning) -> float:
    """Regress the actor's mean on the actions; returns the mean square of what is left, relative to the actions' variance."""
    generator = torch.Generator().manual_seed(seed)
    inputs, targets = torch.from_numpy(seen.astype(np.float32)), torch.from_numpy(actions.astype(np.float32))
    variance = targets.var()
    optimiser = torch.optim.Adam(actor(model), lr=given.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, given.updates)
    model.policy.set_training_mode(True)
    for _ in range(given.updates):
        chosen = torch.randint(len(targets), (given.batch,), generator=generator)
        loss = ((_mean(model, inputs[chosen]) - targets[chosen]) ** 2).mean() / variance
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    model.policy.set_training_mode(False)
    if hasattr(model, "actor_target"):
        model.actor_target.load_state_dict(model.actor.state_dict())
    with torch.no_grad():
        return float(((_mean(model, inputs) - targets) ** 2).mean() / variance)


def actor(model: Any) -> list[torch.nn.Parameter]:
    """The parameters that the mean depends on."""
    if hasattr(model, "actor"):
        return list(model.actor.parameters())
    return [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]


def _mean(model: Any, inputs: torch.Tensor) -> torch.Tensor:
    """Mean actions, shape (N,), before what only limits them."""
    if not hasattr(model, "actor"):
        return model.policy.get_distribution(inputs).distribution.mean[:, 0]
    if hasattr(model.actor, "get_action_dist_params"):
        return torch.tanh(model.actor.get_action_dist_params(inputs)[0][:, 0])
    return model.actor(inputs)[:, 0]
