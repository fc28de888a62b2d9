"""What every test may use."""

import os
from collections.abc import Callable, Iterator
from typing import Any

os.environ.setdefault("MPLBACKEND", "Agg")

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import settings

import mfc_gym  # noqa: F401 (registers the environments)
from mfc_gym.env import TrackingEnv

settings.register_profile("compiled", deadline=None)  # the first call of a kernel compiles it
settings.load_profile("compiled")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def make() -> Iterator[Callable[..., TrackingEnv]]:
    """Builds the plain environment of an id (the chain of the paper if none is given); closed after the test."""
    built: list[gym.Env] = []

    def build(env_id: str = "mfc_gym/PerturbedChain-v0", **keywords: Any) -> TrackingEnv:
        built.append(gym.make(env_id, **keywords))
        return built[-1].unwrapped

    yield build
    for env in built:
        env.close()
