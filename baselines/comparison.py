"""Controllers and groups of trained agents on the same episodes: every run of every policy plays every seed."""

import glob
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from baselines import evaluation, task_id
from baselines.metrics import evaluate
from baselines.rollout import rollout
from baselines.shifts import Shift
from baselines.trajectory import Trajectory
from mfc_gym.simulation import Simulation

Array = NDArray[np.float64]

MEASURES = ("tail_rms", "transient_iae", "return", "escaped", "tail_total_variation_rate")
BLOCK = 256  # episodes played at once
HELD_OUT = 2**29  # the seeds from here on are seen in training, see `baselines.training`


@dataclass(frozen=True)
class Policy:
    """One column of the comparison: a controller, or the agents of several trainings."""

    label: str
    specifications: tuple[str, ...]  # one for each run


@dataclass(frozen=True)
class Played:
    """What the runs of one policy did on one task."""

    entries: tuple[evaluation.Entry, ...]
    scores: Mapping[str, Array]  # metric of MEASURES -> (runs, episodes)
    first: Trajectory  # the first run's first episode


class ZeroInput:
    """No input at all: the zero of normalised scores."""

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Array, Any]:
        """Stable-Baselines3's signature."""
        return np.zeros((*np.shape(observation)[:-1], 1)), state


class Setting:
    """A task under a shift: a scalar environment that tells policies what they may know, and vector ones to play in."""

    def __init__(self, env: str, options: Mapping[str, Any], shift: Shift) -> None:
        env, keywords = task_id.named(env, options)
        base: Any = gym.make(env, **keywords)
        self.env, self.shift = env, shift
        self.applies = shift.applies(keywords, base.unwrapped.simulation)
        self.options = shift.options(keywords, base.unwrapped.simulation)
        self.scalar: Any = gym.make(env, **self.options)
        self.simulation: Simulation = self.scalar.unwrapped.simulation  # type: ignore[attr-defined]
        self._vector: dict[int, Any] = {}

    def play(self, policy: Any, seeds: range) -> Iterator[Trajectory]:
        """The episodes of these seeds, one after the other."""
        for start in range(seeds.start, seeds.stop, BLOCK):
            count = min(BLOCK, seeds.stop - start)
            if count not in self._vector:
                kind: Any = "vector_entry_point"
                self._vector[count] = gym.make_vec(self.env, count, vectorization_mode=kind, **self.options)
            envs = self._vector[count]
            yield from rollout(envs, policy, start, self.shift.reset_options(envs, start)).episodes()

    def scores(self, policy: Any, seeds: range) -> tuple[dict[str, Array], Trajectory]:
        """Each metric of MEASURES over the episodes, and the first episode."""
        rows, first = [], None
        for episode in self.play(policy, seeds):
            first = first or episode
            rows.append(evaluate(episode, self.simulation.input_limit, self.simulation.horizon))
        assert first is not None
        return {name: np.array([row[name] for row in rows]) for name in MEASURES}, first


def settings(env: str, options: Mapping[str, Any], shifts: Mapping[str, Shift]) -> dict[str, Setting]:
    """The task under every shift that changes something about it. Raises ValueError for options that cannot work."""
    found = {name: Setting(env, options, shift) for name, shift in shifts.items()}
    return {name: setting for name, setting in found.items() if setting.applies}


def entries(policy: Policy, setting: Setting) -> tuple[evaluation.Entry, ...]:
    """Every run of a policy, ready. Raises ValueError for one that does not fit."""
    return tuple(evaluation.entry(one, setting.scalar) for one in policy.specifications)


def play(policy: Policy, setting: Setting, seeds: range, progress: Callable[[], object] = lambda: None) -> Played:
    """All runs of a policy on the same episodes."""
    runs, found = [], entries(policy, setting)
    for one in found:
        runs.append(setting.scores(one.policy, seeds))
        progress()
    scores = {name: np.stack([run[name] for run, _ in runs]) for name in MEASURES}
    return Played(found, scores, runs[0][1])


def policies(texts: Sequence[str]) -> list[Policy]:
    """`[label=]specification`: a controller as `evaluation.entry` takes it, or `algorithm:folders`.

    Folders are separated by commas and may contain * and ?; each holds one training. Raises ValueError if there are none.
    """
    if not texts:
        raise ValueError("`policies` must name at least one controller or agent, got none.")
    named = [_label(text) for text in texts]
    short = [label or specification.partition(":")[0] for label, specification in named]
    found = []
    for (label, specification), name in zip(named, short, strict=True):
        agent = specification.partition(":")[0] in evaluation.ALGORITHMS
        default = name if agent and short.count(name) == 1 else specification
        found.append(Policy(label or default, _specifications(specification) if agent else (specification,)))
    labels = [policy.label for policy in found]
    if len(set(labels)) < len(labels):
        raise ValueError(f"`policies` must have labels of their own (label=specification), got {', '.join(labels)}.")
    return found


def _label(text: str) -> tuple[str, str]:
    """(label, specification); an equals sign behind a colon belongs to an option."""
    label, equals, rest = text.partition("=")
    return (label, rest) if equals and ":" not in label else ("", text)


def _specifications(specification: str) -> tuple[str, ...]:
    algorithm, _, folders = specification.partition(":")
    found: list[str] = []
    for pattern in filter(None, folders.split(",")):
        matches = sorted(glob.glob(pattern)) if glob.has_magic(pattern) else [pattern]
        found += [match for match in matches if Path(match).is_dir()]
        if not any(Path(match).is_dir() for match in matches):
            raise ValueError(f"`policies` must name folders of agents, got none at {pattern}.")
    if len({Path(folder).resolve() for folder in found}) < len(found) or not found:
        raise ValueError(f"`policies` must name each agent once, got {', '.join(found) or 'none'} for {specification}.")
    return tuple(f"{algorithm}:{folder}" for folder in found)
