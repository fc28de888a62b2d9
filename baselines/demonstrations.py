"""Episodes of a policy as a Minari dataset, for any offline learner."""

import json
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from baselines.extras import missing
from baselines.provenance import provenance
from baselines.rollout import rollout
from baselines.trajectory import Trajectory

try:
    import h5py  # noqa: F401 (the format on disk)
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
except ModuleNotFoundError as error:
    raise missing("Minari", "interop") from error


def write(
    dataset: str,
    env: gym.Env[Any, Any],
    policy: Any,
    name: str,
    seeds: Sequence[int],
    folder: Path | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Any:
    """Record the episodes of these seeds as the Minari dataset `dataset`, read by `minari.load_dataset`; returns it.

    `folder`: where datasets are kept; None: Minari's own, MINARI_DATASETS_PATH or ~/.minari/datasets.
    Raises ValueError for an id that Minari cannot read or that is taken.
    """
    if folder is not None:
        os.environ["MINARI_DATASETS_PATH"] = str(folder)  # the only way Minari can be told
    _check(dataset)
    simulation: Any = env.unwrapped.simulation  # type: ignore[attr-defined]
    episodes = []
    for seed in seeds:
        episodes.append(_episode(rollout(env, policy, seed=seed), simulation.input_limit, seed))
        progress()
    with warnings.catch_warnings():  # what it would like to know of author and address
        warnings.simplefilter("ignore", UserWarning)
        made = minari.create_dataset_from_buffers(
            dataset, episodes, env=env, algorithm_name=name, data_format="hdf5", requirements=["mfc-gym"]
        )
    made.storage.update_metadata({"provenance": json.dumps(provenance())})
    return made


def _check(dataset: str) -> None:
    try:
        parse_dataset_id(dataset)
    except (ValueError, TypeError) as error:  # TypeError: no version
        raise ValueError(f"`dataset` must be an id like mfc_gym/chain/mfc-v0, got {dataset!r}.") from error
    if dataset in minari.list_local_datasets():
        raise ValueError(f"`dataset` must be new, got {dataset!r}, which exists.")


def _episode(trajectory: Trajectory, input_limit: float, seed: int) -> EpisodeBuffer:
    """One episode: N+1 observations, N actions as the environment takes them."""
    parts = (trajectory.state, trajectory.output_derivatives, trajectory.reference)
    count = trajectory.control.size
    last = np.arange(count) == count - 1
    return EpisodeBuffer(
        seed=seed,
        observations=np.concatenate(parts, axis=-1),
        actions=(trajectory.control / input_limit)[:, None].astype(np.float32),
        rewards=trajectory.reward,
        terminations=last & bool(trajectory.terminated),
        truncations=last & (not trajectory.terminated),
    )
