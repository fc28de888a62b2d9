"""Threads that share a step: all jobs are done, errors reach the caller, nobody waits for somebody else's helpers."""

import multiprocessing
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from test_kernels import folder

from mfc_gym import kernels, team

__all__ = ["folder"]  # a fixture
SOURCE = """
import numpy as np
from mfc_gym.compiled import entry


@entry("void(float64[::1], int64, int64, int64)")
def fill(out, start, stop, divisor):
    for i in range(start, stop):
        out[i] = i / divisor
"""


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> list[team.Helper]:
    """Three helpers, whatever the machine has."""
    made = [team.Helper() for _ in range(3)], threading.Lock()
    monkeypatch.setattr(team, "_helpers", lambda: made)
    return made[0]


@pytest.mark.parametrize("count", [1, 2, 4, 7])
@pytest.mark.parametrize("looks", [0, team.LOOKS])
def test_every_job_is_done(folder: Path, helpers: Any, monkeypatch: pytest.MonkeyPatch, count: int, looks: int) -> None:
    """Fewer jobs than threads, more jobs than threads, helpers awake and asleep."""
    monkeypatch.setattr(team, "LOOKS", looks)
    fill = kernels.load("mfc_test_team", lambda: SOURCE).fill
    for size in range(1, 300):
        out = np.full(size, np.nan)
        edges = np.linspace(0, size, count + 1).astype(int).tolist()
        team.run([fill.bind(out, a, b, 1) for a, b in pairwise(edges)])
        np.testing.assert_array_equal(out, np.arange(size))


@pytest.mark.parametrize("failing", range(4))
def test_a_failure_anywhere_is_raised_and_the_others_are_done(folder: Path, helpers: Any, failing: int) -> None:
    fill = kernels.load("mfc_test_team", lambda: SOURCE).fill
    out = np.full(4, np.nan)
    with pytest.raises(ArithmeticError, match="fill"):
        team.run([fill.bind(out, i, i + 1, 0 if i == failing else 1) for i in range(4)])
    done = [i for i in range(4) if i != failing]
    np.testing.assert_array_equal(out[done], done)
    team.run([fill.bind(out, i, i + 1, 1) for i in range(4)])
    np.testing.assert_array_equal(out, np.arange(4))


def interrupted(*arguments: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["waking", "working"])
def test_an_interrupt_waits_for_those_at_work(
    folder: Path, helpers: Any, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """What the first helper was given is done when the interrupt reaches the caller, whose arrays it writes to."""
    fill = kernels.load("mfc_test_team", lambda: SOURCE).fill
    size = 1_000_000
    out = np.full(4 * size, np.nan)
    jobs = [fill.bind(out, size * i, size * (i + 1), 1) for i in range(4)]
    with monkeypatch.context() as patch:
        if where == "waking":
            turns = iter([interrupted])  # before it is awake, once
            patch.setattr(helpers[1], "_wake", lambda wake=helpers[1]._wake: next(turns, wake)())
        else:
            patch.setattr(type(jobs[0]), "__call__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            team.run(jobs)
    np.testing.assert_array_equal(out[size : 2 * size], np.arange(size, 2 * size))
    team.run(jobs)
    np.testing.assert_array_equal(out, np.arange(4 * size))


def test_after_an_interrupt_an_environment_must_be_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    envs = gym.make_vec("mfc_gym/PerturbedChain-v0", num_envs=4, vectorization_mode="vector_entry_point")
    envs.reset(seed=0)
    with monkeypatch.context() as patch:
        patch.setattr(team, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            envs.step(np.zeros((4, 1)))
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros((4, 1)))
    envs.reset(seed=0)
    envs.step(np.zeros((4, 1)))


def test_who_finds_the_helpers_busy_works_alone(folder: Path, helpers: Any) -> None:
    fill = kernels.load("mfc_test_team", lambda: SOURCE).fill
    _, lock = team._helpers()
    out = np.full(4, np.nan)
    with lock:
        team.run([fill.bind(out, i, i + 1, 1) for i in range(4)])
    np.testing.assert_array_equal(out, np.arange(4))
    assert lock.acquire(blocking=False)


def episodes(seed: int) -> np.ndarray:
    envs = gym.make_vec(
        "mfc_gym/PerturbedChain-v0", num_envs=600, vectorization_mode="vector_entry_point", threads=4, scenario="random"
    )
    envs.reset(seed=seed)
    actions = np.random.default_rng(seed).uniform(-1, 1, (40, 600, 1))
    return np.array([envs.step(a)[0] for a in actions])


def test_two_threads_of_the_user_do_not_disturb_each_other(helpers: Any) -> None:
    expected = [episodes(seed) for seed in (0, 1)]
    found: dict[int, np.ndarray] = {}
    threads = [threading.Thread(target=lambda s=s: found.update({s: episodes(s)})) for s in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    for seed in (0, 1):
        np.testing.assert_array_equal(found[seed], expected[seed])


def _in_child(queue: Any) -> None:
    queue.put(episodes(0))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # that forking with threads may hang: the helpers must not
def test_helpers_are_made_anew_after_a_fork() -> None:
    expected = episodes(0)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    np.testing.assert_array_equal(queue.get(timeout=120), expected)
    child.join(60)
    assert child.exitcode == 0
