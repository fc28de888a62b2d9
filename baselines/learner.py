"""Stable-Baselines3's algorithms by name, built from the table of hyperparameters."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise

from baselines.agents import make_vec_env
from baselines.collection import PPO
from baselines.hyperparameters import Hyperparameters
from baselines.interface import Interface
from baselines.policy_network import Features
from baselines.sb3_weights import ACTORS
from baselines.training_env import PLAIN, Terms, TrainingEnv

ALGORITHMS: dict[str, Any] = {"ppo": PPO, "sac": SAC, "td3": TD3, "tqc": TQC, "crossq": CrossQ}
ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
TRAINING = 2**31  # first seed of the training's episodes


def build(
    algorithm: str,
    env: str,
    options: Mapping[str, Any],
    given: Hyperparameters,
    seen: Features,
    seed: int,
    interface: Interface = PLAIN,
    terms: Terms = Terms(),  # noqa: B008
) -> Any:
    """The untrained model on its environments. Where it corrects a controller its mean is zero at first."""
    venv = make_vec_env(env, given.num_envs, **options)
    (simulation,) = venv.get_attr("simulation", 0)
    scaled = TrainingEnv(venv, seen, given.options["gamma"], simulation, interface, terms)
    policy = {"net_arch": list(given.hidden), "activation_fn": ACTIVATIONS[given.activation], **given.policy}
    noise = {"action_noise": NormalActionNoise(np.zeros(1), np.full(1, given.noise))} if given.noise else {}
    rate, kind = given.learning_rate, ALGORITHMS[algorithm]
    model = kind("MlpPolicy", scaled, rate, policy_kwargs=policy, seed=seed, device="cpu", **given.options, **noise)
    if interface.base is not None:
        silence(model)
    return model


def silence(model: Any) -> None:
    """Zero the actor's last layer."""
    prefix = ACTORS[type(model).__name__].prefixes[-1]
    modules = model.policy.named_modules()
    last = [module for name, module in modules if name.startswith(prefix) and isinstance(module, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
    if hasattr(model, "actor_target"):
        model.actor_target.load_state_dict(model.actor.state_dict())


def begin_segment(model: Any, given: Hyperparameters, seed: int, timesteps: int) -> None:
    """New episodes and random numbers, learning rate and exploration: all from the seed and the timesteps so far only."""
    drawn = np.random.SeedSequence((seed, model.num_timesteps)).generate_state(1, np.uint32)[0]
    model.set_random_seed(TRAINING + int(drawn) % (TRAINING - given.num_envs))
    model._last_obs = None  # has the environments reset
    done = min(1.0, model.num_timesteps / timesteps)
    rate = given.learning_rate * (1.0 - given.falling * done)
    model.lr_schedule = lambda _: rate
    if given.log_std is not None:
        start, end = given.log_std
        model.policy.log_std.requires_grad_(False).fill_(start + (end - start) * done)
