"""The table of hyperparameters as rl_zoo3 reads it: one YAML file for each algorithm, one entry for each plant.

`python -m rl_zoo3.train --algo ppo --env ID --gym-packages mfc_gym --conf-file ppo.yml`. What rl_zoo3 has no word for does
not carry over: new episodes at every segment, the schedule of PPO's exploration (its start does), the native vector environment.
"""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from baselines.hyperparameters import PLANTS, Hyperparameters, hyperparameters

CHAIN = "mfc_gym/PerturbedChain-v0"
ACTIVATIONS = {"tanh": "nn.Tanh", "relu": "nn.ReLU"}


def entries(algorithm: str) -> dict[str, dict[str, Any]]:
    """Entries by environment id: the chain, and the plants that have their own."""
    others = (env for env, given in PLANTS.items() if algorithm in given)
    return {env: entry(algorithm, env) for env in dict.fromkeys((CHAIN, *others))}


def entry(algorithm: str, env: str) -> dict[str, Any]:
    """An algorithm's hyperparameters on a plant in rl_zoo3's words."""
    given = hyperparameters(algorithm, env)
    dt, horizon = given.environment["dt"], given.environment["horizon"]
    episode = max(1, round(given.episode * horizon / dt)) * dt
    scaled = {"gamma": given.options["gamma"], "horizon": horizon}
    noise = {"noise_type": "normal", "noise_std": given.noise} if given.noise else {}
    return {
        "env_kwargs": {"scenario": "random", **given.environment, "horizon": episode},
        "vec_env_wrapper": {"baselines.training_env.scaled": scaled},
        "n_envs": given.num_envs,
        "n_timesteps": given.timesteps,
        "policy": "MlpPolicy",
        "policy_kwargs": _policy(given),
        "learning_rate": f"lin_{given.learning_rate}" if given.falling else given.learning_rate,
        **given.options,
        **noise,
    }


def _policy(given: Hyperparameters) -> str:
    """rl_zoo3 evaluates it as Python, where `nn` is PyTorch's."""
    policy = {"net_arch": list(given.hidden), **given.policy}
    if given.log_std is not None:
        policy["log_std_init"] = given.log_std[0]
    words = [f"{name}={value!r}" for name, value in policy.items()]
    return f"dict({', '.join([*words, f'activation_fn={ACTIVATIONS[given.activation]}'])})"


def to_yaml(data: Mapping[str, Any]) -> str:
    """Nested mappings of numbers, strings and lists as YAML."""
    return "\n".join(_lines(data, "")) + "\n"


def _lines(data: Mapping[str, Any], indent: str) -> Iterator[str]:
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            yield from _lines(value, indent + "  ")
        else:
            yield f"{indent}{key}: {_scalar(value)}"


def _scalar(value: Any) -> str:
    """YAML reads 1e-05 as a string: a float needs its point."""
    text = json.dumps(value)
    return text.replace("e", ".0e") if isinstance(value, float) and "e" in text and "." not in text else text
