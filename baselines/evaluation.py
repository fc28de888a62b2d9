"""Policies compared on the same episodes: policy specifications, paired seeds, metrics, results on disk."""

import csv
import math
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from baselines import imported, registry
from baselines.exact_metrics import total_variation
from baselines.files import replace
from baselines.filippov import filippov
from baselines.metrics import METRICS, evaluate
from baselines.redesign import LyapunovRedesign
from baselines.rollout import rollout
from baselines.trajectory import Trajectory

ALGORITHMS = ("ppo", "sac", "td3", "tqc", "crossq")
OWN = re.compile(r"([\w.]+:\w+)(?=:|$)")  # a factory in a module, before its options
EXTRA = {"variation_ratio": "1", "step_time": "us"}  # metrics that need more than the trajectory


@dataclass(frozen=True)
class Entry:
    """One policy of a comparison."""

    label: str
    policy: Any  # anything with Stable-Baselines3's `predict`
    reads: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """What one policy did: metrics per episode, and the first episode itself."""

    entry: Entry
    episodes: list[dict[str, float]]
    first: Trajectory


def entry(specification: str, env: gym.Env[Any, Any]) -> Entry:
    """The policy of a specification: `controller`, `controller:option=value,...`, `algorithm:folder` for a trained agent, or
    `module:factory` (then `module:factory:option=value,...`) for one of your own, `factory(nominal, **options)`.

    Raises ValueError with the known names, for options the controller does not take, or an agent file that is not sound.
    """
    name, _, rest = specification.partition(":")
    if name in ALGORITHMS:
        return _agent(specification, name, rest, env)
    own = None if name in registry.CONTROLLERS else OWN.match(specification)
    name, options = parse(specification[own.end() :] if own else specification)
    if own:
        policy = registry.call(own[1], imported.factory(own[1]), env.unwrapped.nominal, options)  # type: ignore[attr-defined]
    else:
        policy = registry.make(name, env, **options)
    return Entry(specification, policy, tuple(getattr(policy, "reads", ("observation",))), options)


def parse(specification: str) -> tuple[str, dict[str, Any]]:
    """(name, options) of a specification. Raises ValueError for text that is not `name` or `name:option=value,...`."""
    name, _, rest = specification.partition(":")
    options: dict[str, Any] = {}
    for item in filter(None, _split(rest)):
        key, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"a specification must be name or name:option=value,..., got {specification!r}.")
        options[key] = _value(value)
    return name, options


def _agent(specification: str, algorithm: str, folder: str, env: gym.Env[Any, Any]) -> Entry:
    """A trained agent from its files, which run no code."""
    from baselines.agent_files import load_agent

    agent, size = load_agent(folder, algorithm).made_for(env), env.observation_space.shape
    if size != (agent.observation_size,):
        raise ValueError(
            f"`controllers`: {specification} was trained on {agent.observation_size} numbers, the environment has {size}."
        )
    return Entry(specification, agent, agent.reads, {"environment": dict(agent.environment)})


def _split(text: str) -> list[str]:
    """Split at commas outside parentheses."""
    parts, depth = [""], 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def _value(text: str) -> Any:
    """A number, a tuple of numbers "(1, 2)", or the text itself."""
    if text.startswith("(") and text.endswith(")"):
        return tuple(float(part) for part in text[1:-1].split(",") if part.strip())
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        return text


def step_time(policy: Any, env: gym.Env[Any, Any], seed: int, steps: int = 200, warm_up: int = 20) -> float:
    """Median time of one `predict`, us."""
    observation, _ = env.reset(seed=seed)
    state, times = None, []
    for _ in range(steps + warm_up):
        begin = time.perf_counter()
        action, state = policy.predict(observation, state=state, deterministic=True)
        times.append(time.perf_counter() - begin)
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            observation, state = env.reset()[0], None
    return 1e6 * float(np.median(times[warm_up:]))


def run(
    one: Entry,
    env: gym.Env[Any, Any],
    seeds: Sequence[int],
    exact: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> Result:
    """The episodes of these seeds; the first `exact` also with the control's variation over the exact one's."""
    simulation: Any = env.unwrapped.simulation  # type: ignore[attr-defined]
    episodes: list[dict[str, float]] = []
    first, count = None, 0 if simulation.driving.moves else exact
    for i, seed in enumerate(seeds):
        trajectory = rollout(env, one.policy, seed=seed)
        first = first or trajectory
        metrics = evaluate(trajectory, simulation.input_limit, simulation.horizon)
        if i == 0:
            metrics["step_time"] = step_time(one.policy, env, seed)
        if i < count and isinstance(one.policy, LyapunovRedesign) and not trajectory.terminated:
            solution = filippov(env, one.policy, seed=seed)
            if not solution.terminated:
                metrics["variation_ratio"] = metrics["total_variation"] / total_variation(solution)
        episodes.append(metrics)
        progress()
    assert first is not None
    return Result(one, episodes, first)


def column(result: Result, metric: str) -> np.ndarray:
    """One metric over the episodes that have it."""
    return np.array([episode[metric] for episode in result.episodes if metric in episode])


def as_data(results: Iterable[Result]) -> list[dict[str, Any]]:
    """Results as plain JSON data; what is not finite becomes null."""
    return [
        {
            "controller": result.entry.label,
            "reads": list(result.entry.reads),
            "options": {k: list(v) if isinstance(v, tuple) else v for k, v in result.entry.options.items()},
            "episodes": [{k: v if math.isfinite(v) else None for k, v in e.items()} for e in result.episodes],
        }
        for result in results
    ]


def units() -> dict[str, str]:
    """Unit of every metric."""
    return {name: metric.unit for name, metric in METRICS.items()} | EXTRA


def writable(folder: Path) -> Path:
    """The folder, made if need be. Raises ValueError if nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(f"`out` must be a folder that can be written, got {folder} ({error.strerror}).") from error
    return folder


def write_csv(path: Path, results: Iterable[Result], seeds: Sequence[int]) -> None:
    """One line per controller and episode."""

    def write(target: Path) -> None:
        with target.open("w", newline="") as file:
            writer = csv.DictWriter(file, ["controller", "seed", *units()], restval="")
            writer.writeheader()
            for result in results:
                for seed, episode in zip(seeds, result.episodes, strict=True):
                    writer.writerow({"controller": result.entry.label, "seed": seed, **episode})

    replace(path, write)
