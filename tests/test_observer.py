"""What a learner sees of the past: formulas, and the same alone, in a batch and after a new start."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from baselines.observer import MAX_PAST, Observer, observer

Array = NDArray[np.float64]
D, N = 10, 3  # a plant of order 3


def watch(one: Observer, observations: Array, actions: Array, starts: Array | None = None) -> Array:
    """Signals along (T, B, d) with the actions (T, B) that follow; `starts` (T, B): where episodes begin."""
    memory = np.full((observations.shape[1], one.memory_size(D)), np.nan)  # void
    seen = []
    for k, (now, action) in enumerate(zip(observations, actions, strict=True)):
        fresh = np.full(len(now), k == 0) if starts is None else starts[k]
        seen.append(one.see(now, memory, fresh))
        one.acted(action, memory)
    return np.array(seen)


def test_nothing_asked_for_is_the_observation(rng: np.random.Generator) -> None:
    observations = rng.normal(size=(4, 2, D))
    assert np.array_equal(watch(Observer(), observations, np.zeros((4, 2))), observations)
    assert Observer().memory_size(D) == 0


def test_integral_is_trapezoidal(rng: np.random.Generator) -> None:
    observations = rng.normal(size=(30, 2, D))
    error = observations[..., N] - observations[..., 2 * N]
    seen = watch(Observer(integral=True, dt=0.1), observations, np.zeros((30, 2)))[..., -1]
    expected = np.array([np.trapezoid(error[: k + 1], dx=0.1, axis=0) for k in range(30)])
    assert np.abs(seen - expected).max() < 1e-14


def test_last_action_and_past_are_those_before(rng: np.random.Generator) -> None:
    """Frames of observation and last action, the newest first; before the start all are the first one."""
    observations, actions = rng.normal(size=(6, 2, D)), rng.normal(size=(6, 2))
    seen = watch(Observer(last_action=True, past=2), observations, actions)
    frames = np.concatenate([observations, np.vstack([np.zeros((1, 2)), actions[:-1]])[..., None]], axis=-1)
    for k in range(6):
        expected = np.concatenate([frames[k], frames[max(k - 1, 0)], frames[max(k - 2, 0)]], axis=-1)
        assert np.array_equal(seen[k], expected)


def test_output_only_hides_the_rest(rng: np.random.Generator) -> None:
    """Whatever x and the derivatives of y are."""
    observations = rng.normal(size=(5, 2, D))
    other = observations.copy()
    other[..., :N] = rng.normal(size=(5, 2, N))
    other[..., N + 1 : 2 * N] = rng.normal(size=(5, 2, N - 1))
    one = Observer(integral=True, last_action=True, past=3, output_only=True, dt=0.1)
    actions = rng.normal(size=(5, 2))
    assert np.array_equal(watch(one, observations, actions), watch(one, other, actions))
    assert one.reads == ("output",)


@pytest.mark.parametrize(
    "words", [(), ("integral",), ("past:3",), ("integral", "last-action", "past:2", "output-only")]
)
def test_a_new_start_forgets_and_rows_are_independent(words: tuple[str, ...], rng: np.random.Generator) -> None:
    """A batch whose rows begin anew at different times sees what each episode alone sees, to the last bit."""
    one = observer(words)
    observations, actions = rng.normal(size=(12, 3, D)), rng.normal(size=(12, 3))
    starts = np.zeros((12, 3), dtype=bool)
    starts[0], starts[5, 0], starts[7, 2] = True, True, True
    seen = watch(one, observations, actions, starts)
    assert seen.shape[-1] == one.size(D)
    for row, edges in enumerate(([0, 5, 12], [0, 12], [0, 7, 12])):
        for a, b in pairwise(edges):
            alone = watch(one, observations[a:b, row : row + 1], actions[a:b, row : row + 1])
            assert np.array_equal(seen[a:b, row], alone[:, 0])


@pytest.mark.parametrize("word", ["past", "past:-1", "past:x", f"past:{MAX_PAST + 1}", "integral:2", "theta", "dt", ""])
def test_unknown_words_are_refused(word: str) -> None:
    with pytest.raises(ValueError, match=r"`observe` must be of|`past` must be an integer"):
        observer((word,))
