"""How each algorithm is trained: one table, by name, and what other plants need instead. A new algorithm is one entry.

The values were found on `mfc_gym/PerturbedChain-v0`, random scenario, dt = 0.02 s; see `docs/learning.md`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

FADE = 2.0  # widths of the error in which a correction fades, in its standard deviations


@dataclass(frozen=True)
class Hyperparameters:
    """What an algorithm is built with. Everything is plain data."""

    timesteps: int  # of all environments together
    segment: int  # timesteps between two evaluations and checkpoints; episodes begin anew there
    num_envs: int
    learning_rate: float  # at the start
    falling: bool  # the learning rate falls linearly to zero
    activation: str  # of `baselines.policy_network.ACTIVATIONS`
    hidden: tuple[int, ...]  # widths of the hidden layers, of the actor and of the critic
    options: Mapping[str, Any]  # of the algorithm's constructor, gamma among them
    policy: Mapping[str, Any] = field(default_factory=dict)  # further `policy_kwargs`
    episode: float = (
        0.3  # length of the training's episodes over the horizon: the shorter, the more transients are seen
    )
    noise: float = 0.0  # standard deviation of the action noise, in actions
    log_std: tuple[float, float] | None = None  # of a Gaussian policy, at the start and at the end; None: it is learnt
    environment: Mapping[str, Any] = field(default_factory=lambda: {"dt": 0.02, "horizon": 10.0})  # s


OFF_POLICY: dict[str, Any] = {
    "gamma": 0.98,
    "buffer_size": 300_000,
    "learning_starts": 8_000,
    "batch_size": 512,
    "train_freq": 1,  # steps of the vector environment
    "gradient_steps": 4,
}
TAU: dict[str, Any] = {"tau": 0.01}  # CrossQ has no target networks
ENTROPY: dict[str, Any] = {"ent_coef": "auto_0.01", "target_entropy": -0.5}
FUSED: dict[str, Any] = {"optimizer_kwargs": {"fused": True}}  # Adam in one call: a third of a small network's update

HYPERPARAMETERS: dict[str, Hyperparameters] = {
    "ppo": Hyperparameters(
        timesteps=2_031_616,
        segment=65_536,
        num_envs=64,
        learning_rate=1e-3,
        falling=True,
        activation="tanh",
        hidden=(64, 64),
        options={"gamma": 0.98, "gae_lambda": 0.95, "n_steps": 128, "batch_size": 1024, "n_epochs": 10},
        log_std=(-1.0, -1.5),
    ),
    "sac": Hyperparameters(
        timesteps=1_024_000,
        segment=32_000,
        num_envs=64,
        learning_rate=7e-4,
        falling=True,
        activation="relu",
        hidden=(64, 64),
        options=OFF_POLICY | TAU | ENTROPY,
        policy=FUSED,
    ),
    "td3": Hyperparameters(
        timesteps=1_280_000,
        segment=32_000,
        num_envs=64,
        learning_rate=7e-4,
        falling=True,
        activation="relu",
        hidden=(64, 64),
        options=OFF_POLICY | TAU | {"target_policy_noise": 0.1, "target_noise_clip": 0.2},
        policy=FUSED,
        noise=0.2,
    ),
    "tqc": Hyperparameters(
        timesteps=640_000,
        segment=32_000,
        num_envs=64,
        learning_rate=7e-4,
        falling=True,
        activation="relu",
        hidden=(64, 64),
        options=OFF_POLICY | TAU | ENTROPY | {"top_quantiles_to_drop_per_net": 1},
        policy=FUSED | {"n_quantiles": 10},
    ),
    "crossq": Hyperparameters(
        timesteps=1_024_000,
        segment=32_000,
        num_envs=64,
        learning_rate=7e-4,
        falling=True,
        activation="relu",
        hidden=(64, 64),
        options=OFF_POLICY | ENTROPY,
        policy=FUSED,
    ),
}

# by environment id and algorithm: the fields that differ from the algorithm's entry; mappings are merged
PLANTS: dict[str, dict[str, dict[str, Any]]] = {
    "mfc_gym/TwoMassSpring-v0": {"ppo": {"timesteps": 3_014_656}},  # four states, no damping
}


def hyperparameters(algorithm: str, env: str) -> Hyperparameters:
    """The algorithm's entry with what the plant has in its place. Raises KeyError for an unknown algorithm."""
    given = HYPERPARAMETERS[algorithm]
    other = PLANTS.get(env, {}).get(algorithm, {})
    merged: dict[str, Any] = {k: {**getattr(given, k), **v} if isinstance(v, Mapping) else v for k, v in other.items()}
    return replace(given, **merged)
