"""How good an agent is while it learns: always the same episodes, also for the reference policy."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from baselines import registry
from baselines.metrics import evaluate
from baselines.rollout import rollout

Row = dict[str, Any]


class Evaluation:
    """The same episodes for every agent and for the reference policy, seeded `seed`, `seed` + 1, ...."""

    def __init__(self, env: str, options: Mapping[str, Any], episodes: int, seed: int) -> None:
        self.envs: Any = gym.make_vec(env, episodes, vectorization_mode="vector_entry_point", **options)
        unwrapped: Any = self.envs.unwrapped
        self.simulation = unwrapped.simulation
        self.seed = seed
        self.reference: Row = self(registry.make("mfc", self.envs))

    def __call__(self, policy: Any) -> Row:
        """Mean return, median and worst tail RMS (None: an episode left the region), and the number that left it."""
        limit, horizon = self.simulation.input_limit, self.simulation.horizon
        trajectory = rollout(self.envs, policy, seed=self.seed)
        episodes = [evaluate(one, limit, horizon) for one in trajectory.episodes()]
        tail = np.array([one["tail_rms"] for one in episodes])
        return {
            "return": float(np.mean([one["return"] for one in episodes])),
            "tail_rms": _finite(np.median(tail)),
            "tail_rms_worst": _finite(tail.max()),
            "escaped": int(sum(one["escaped"] for one in episodes)),
        }


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
