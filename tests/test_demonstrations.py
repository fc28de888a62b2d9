"""Recorded episodes are what was played: read back by Minari and played again."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest

from scripts import record_episodes

DATASET = "mfc_gym/chain/mfc-v0"


@pytest.fixture
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    record_episodes.main(record_episodes.Arguments("mfc", episodes=3, seed=4, dt=0.05, horizon=1.0, out=tmp_path))
    return minari.load_dataset(DATASET)


def test_a_dataset_comes_back_and_can_be_played_again(dataset: Any) -> None:
    """Its own environment, seeds and actions give its observations, to the rounding of float32 actions, and its rewards."""
    env = dataset.recover_environment()
    episodes = list(dataset.iterate_episodes())
    assert [int(one.seed) if hasattr(one, "seed") else 4 + i for i, one in enumerate(episodes)] == [4, 5, 6]
    for i, one in enumerate(episodes):
        observation, _ = env.reset(seed=4 + i)
        seen, rewards, ended = [observation], [], []
        for action in one.actions:
            observation, reward, terminated, truncated, _ = env.step(action)
            seen.append(observation)
            rewards.append(reward)
            ended.append((terminated, truncated))
        assert np.abs(np.array(seen) - one.observations).max() < 1e-4  # 50 times 2^-24, integrated thrice over 1 s
        assert np.abs(np.array(rewards) - one.rewards).max() < 1e-5
        assert ended == list(zip(one.terminations, one.truncations, strict=True))
        assert ended[-1] == (False, True)


def test_a_dataset_says_where_it_comes_from(dataset: Any) -> None:
    metadata = dataset.storage.metadata
    assert (metadata["total_episodes"], metadata["total_steps"], metadata["algorithm_name"]) == (3, 60, "mfc")
    assert '"versions"' in metadata["provenance"]
    assert gym.spec(dataset.env_spec.id).id == "mfc_gym/PerturbedChain-v0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dataset": DATASET}, "`dataset` must be new"),
        ({"dataset": "../../mfc-v0"}, "`dataset` must be an id like"),
        ({"dataset": "mfc"}, "`dataset` must be an id like"),
        ({"episodes": 0}, "`episodes` must be at least 1"),
    ],
)
def test_what_cannot_be_recorded_is_refused(
    dataset: Any, arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        record_episodes.main(record_episodes.Arguments("mfc", out=tmp_path, horizon=1.0, **arguments))
    assert minari.load_dataset(DATASET).total_episodes == 3
