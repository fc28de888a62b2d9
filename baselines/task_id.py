"""Which environment a command line names."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

import mfc_gym  # noqa: F401 (registers the environments)
from baselines import imported

OURS = "mfc_gym."  # where the entry points lie


def named(env: str, options: Mapping[str, Any] | None = None) -> tuple[str, dict[str, Any]]:
    """(id, keywords) for `gym.make` of an id, of "module:id" whose module registers it, or of a plant file.

    Raises ValueError for an environment that does not track an output, gymnasium.error.Error for an unknown id.
    """
    keywords = dict(options or {})
    if env.endswith(".toml"):
        return "mfc_gym/Plant-v0", {"system": env, **keywords}
    registering, _, id = env.rpartition(":")
    if registering:
        imported.module(registering)
    if not str(gym.spec(id).entry_point).startswith(OURS):
        raise ValueError(f"`env` must be an environment of mfc_gym or a plant file ending in .toml, got {env!r}.")
    return id, keywords


def make(env: str, options: Mapping[str, Any] | None = None) -> gym.Env[Any, Any]:
    """The environment. Raises as `named`, and for options it does not take."""
    id, keywords = named(env, options)
    return gym.make(id, **keywords)
