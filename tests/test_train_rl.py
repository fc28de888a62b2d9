"""Training learns, resumes after SIGKILL where it was, and says what it cannot do."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import baselines  # noqa: E402
from baselines.agent_files import load_agent  # noqa: E402
from baselines.checkpoint import BUFFER  # noqa: E402
from baselines.hyperparameters import HYPERPARAMETERS  # noqa: E402
from baselines.learner import TRAINING  # noqa: E402
from baselines.training import VALIDATION, Plan, Training, train  # noqa: E402
from baselines.training_env import SCALING  # noqa: E402
from baselines.validation import Evaluation, Row  # noqa: E402
from scripts import train_rl  # noqa: E402

ROOT = Path(__file__).parents[1]
ENV, OPTIONS = "mfc_gym/PerturbedChain-v0", {"scenario": "random", "dt": 0.05, "horizon": 3.0}


class Constant:
    """The same action always; None: a random one."""

    def __init__(self, action: float | None) -> None:
        self.action, self.rng = action, np.random.default_rng(0)

    def predict(self, observation: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        size = (len(observation), 1)
        return self.rng.uniform(-1, 1, size) if self.action is None else np.full(size, self.action), None


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every algorithm with segments of a second."""
    for name, given in HYPERPARAMETERS.items():
        options = dict(given.options)
        if name == "ppo":
            options |= {"n_steps": 32, "batch_size": 256, "n_epochs": 2}
        else:
            options |= {"learning_starts": 400, "buffer_size": 2000, "gradient_steps": 1}
        monkeypatch.setitem(HYPERPARAMETERS, name, replace(given, num_envs=16, segment=512, options=options))


def without_time(curve: list[Row]) -> list[Row]:
    return [{k: v for k, v in row.items() if k != "seconds"} for row in curve]


def test_a_short_training_beats_zero_and_random_action(tmp_path: Path) -> None:
    """On the defaults and by far, on episodes it has not seen; and what is on disk is what was evaluated."""
    options = {"scenario": "random", "dt": 0.02, "horizon": 10.0}
    training = train(Plan("ppo", ENV, options, seed=0, timesteps=131_072, episodes=32), tmp_path)
    held_out = Evaluation(ENV, options, episodes=64, seed=0)
    found = held_out(load_agent(tmp_path / "best"))
    for other in (Constant(0.0), Constant(None)):
        assert found["return"] > 0.3 * held_out(other)["return"]
    assert training.curve[-1]["return"] > training.curve[0]["return"]


@pytest.mark.parametrize("algorithm", list(HYPERPARAMETERS))
def test_resumed_training_is_the_uninterrupted_one(algorithm: str, short: None, tmp_path: Path) -> None:
    """Networks, optimisers, replay buffer and random numbers: the curve and the agent agree to the last bit."""
    plan = Plan(algorithm, ENV, OPTIONS, seed=1, timesteps=2048, episodes=4)
    whole = train(plan, tmp_path / "whole")
    interrupted = Training(plan)
    interrupted.model.set_logger(whole.model.logger.__class__(None, []))
    interrupted.segment(lambda timesteps: None)
    interrupted.segment(lambda timesteps: None)
    interrupted.save(tmp_path / "resumed")
    interrupted.segment(lambda timesteps: None)  # lost
    resumed = train(plan, tmp_path / "resumed", resume=True)
    assert without_time(resumed.curve) == without_time(whole.curve)
    assert [row["timesteps"] for row in resumed.curve] == [512, 1024, 1536, 2048]
    if algorithm != "ppo":
        one, other = whole.model.replay_buffer, resumed.model.replay_buffer
        assert (one.pos, one.full) == (other.pos, other.full)
        assert all(np.array_equal(getattr(one, array), getattr(other, array)) for array in BUFFER)
    for name in ("best", "last"):
        agents = [load_agent(tmp_path / run / name) for run in ("whole", "resumed")]
        for (w, b), (v, c) in zip(*(agent.layers for agent in agents), strict=True):
            assert np.array_equal(w, v)
            assert np.array_equal(b, c)


COMMAND = """
import sys
from dataclasses import replace
from baselines.hyperparameters import HYPERPARAMETERS as table
given = table["sac"]
options = {**given.options, "learning_starts": 400, "buffer_size": 2000, "gradient_steps": 1}
table["sac"] = replace(given, num_envs=16, segment=512, options=options)
from scripts.train_rl import run
run()
"""


def test_killed_training_resumes_without_a_gap(tmp_path: Path) -> None:
    """SIGKILL at moments that do not ask what is being written; `last` is whole each time after the resume."""
    arguments = [
        "sac",
        "--timesteps",
        "3072",
        "--dt",
        "0.05",
        "--horizon",
        "2",
        "--episodes",
        "4",
        "--out",
        str(tmp_path),
    ]
    command, checkpoint = [sys.executable, "-c", COMMAND, *arguments], tmp_path / "checkpoint.pt"
    for wait in (0.0, 0.7):
        seen = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and (not checkpoint.exists() or checkpoint.stat().st_mtime_ns == seen):
                time.sleep(0.01)
            time.sleep(wait)
            process.send_signal(signal.SIGKILL)
        command = [sys.executable, "-c", COMMAND, *arguments, "--resume"]
    subprocess.run(command, check=True, capture_output=True)
    curve = json.loads((tmp_path / "last" / "agent.json").read_text())["training"]["curve"]
    assert [row["timesteps"] for row in curve] == [512, 1024, 1536, 2048, 2560, 3072]


def test_training_ends_when_nothing_gets_better(short: None, tmp_path: Path) -> None:
    plan = Plan("ppo", ENV, OPTIONS, seed=0, timesteps=10**9, episodes=2, patience=1)
    training = train(plan, tmp_path)
    returns = [row["return"] for row in training.curve]
    assert returns[-1] <= max(returns[:-1])
    assert np.array_equal(load_agent(tmp_path / "best").layers[0][0], training.best.layers[0][0])  # type: ignore[union-attr]


def test_the_seeds_of_training_and_evaluation_are_disjoint() -> None:
    assert 0 < SCALING < VALIDATION < TRAINING
    assert all(given.num_envs < VALIDATION for given in HYPERPARAMETERS.values())


def test_a_training_is_neither_overwritten_nor_mixed(short: None, tmp_path: Path) -> None:
    plan = Plan("ppo", ENV, OPTIONS, seed=0, timesteps=512, episodes=2)
    with pytest.raises(ValueError, match="`resume` must find a training in `out`, got none in"):
        train(plan, tmp_path, resume=True)
    train(plan, tmp_path)
    with pytest.raises(ValueError, match="`out` must not hold a training"):
        train(plan, tmp_path)
    with pytest.raises(ValueError, match=r"`resume` must be given the arguments .* other \['seed'\]"):
        train(replace(plan, seed=1), tmp_path, resume=True)
    (tmp_path / "checkpoint.pt").write_bytes(b"something else")
    with pytest.raises(ValueError, match="`out` must hold a checkpoint"):
        train(plan, tmp_path, resume=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"algorithm": "a2c"}, "`algorithm` must be one of"),
        ({"algorithm": "ppo", "timesteps": 0}, "`timesteps` must be at least 1"),
        ({"algorithm": "ppo", "seed": -1}, "`seed` must be at least 0"),
        ({"algorithm": "ppo", "patience": 0}, "`patience` must be at least 1"),
        ({"algorithm": "ppo", "dt": -1.0}, "`dt` must be positive"),
        ({"algorithm": "ppo", "scenario": "wild"}, "`scenario` must be one of"),
    ],
)
def test_arguments_that_cannot_work_are_refused(arguments: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        train_rl.main(train_rl.Arguments(out=tmp_path, **arguments))
    assert not list(tmp_path.iterdir())


def test_an_agent_runs_as_any_policy(short: None, tmp_path: Path) -> None:
    """One episode and a batch of them see the same actions."""
    train(Plan("ppo", ENV, OPTIONS, seed=0, timesteps=512, episodes=2), tmp_path)
    agent = load_agent(tmp_path / "last", "ppo")
    env = gym.make(ENV, **OPTIONS)
    envs = gym.make_vec(ENV, 3, vectorization_mode="vector_entry_point", **OPTIONS)
    batch = list(baselines.rollout(envs, agent, seed=5).episodes())
    for i, episode in enumerate(batch):
        alone = baselines.rollout(env, agent, seed=5 + i)
        assert np.abs(alone.control - episode.control).max() < 1e-3  # float32 actions, times the input limit
    assert agent.environment["options"] == OPTIONS


@pytest.mark.parametrize(("name", "tail"), [("ppo-perturbed-chain", 2.3e-3), ("ppo-two-mass-spring", 0.016)])
def test_the_shipped_agents_do_what_is_said_of_them(name: str, tail: float) -> None:
    """No escape at 50 Hz, and a median tail RMS of at most 4/3 of what the document says of 1000 episodes."""
    agent = load_agent(ROOT / "agents" / name, "ppo")
    found = Evaluation(agent.environment["id"], agent.environment["options"], episodes=200, seed=0)(agent)
    assert found["escaped"] == 0
    assert found["tail_rms"] < tail
