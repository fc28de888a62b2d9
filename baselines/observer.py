"""What a learner sees of an observation and of what came before it; the memory travels through arguments."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mfc_gym import observation as layout

Array = NDArray[np.float64]
MAX_PAST = 64  # frames


@dataclass(frozen=True)
class Observer:
    """Signals [view, last action, integral, earlier frames] of observations (N, d = 3 n + 1).

    The view is the observation or, for `output_only`, [y, y_d ... y_d^(n)]. A frame is the view with the last action, where that
    is seen; before an episode's first observation all frames are its first one and the last action is 0.
    """

    integral: bool = False  # of y - y_d since the episode's start, trapezoidal
    last_action: bool = False  # u / input_limit
    past: int = 0  # how many earlier frames
    output_only: bool = False  # hides x and xi_n except y
    dt: float = 1.0  # s, sampling time; for the integral

    def __post_init__(self) -> None:
        if isinstance(self.past, bool) or not isinstance(self.past, int) or not 0 <= self.past <= MAX_PAST:
            raise ValueError(f"`past` must be an integer from 0 to {MAX_PAST}, got {self.past!r}.")

    @property
    def reads(self) -> tuple[str, ...]:
        """As `baselines.controller.Controller.reads`."""
        return ("output",) if self.output_only else ("state", "output derivatives")

    def view(self, observations: Array) -> Array:
        """What is seen of observations (..., d), shape (..., v)."""
        if not self.output_only:
            return observations
        n = layout.order(observations)
        return np.concatenate([observations[..., n : n + 1], observations[..., 2 * n :]], axis=-1)

    def frame(self, d: int) -> int:
        """Numbers of a frame."""
        return self.view(np.empty(d)).size + self.last_action

    def memory_size(self, d: int) -> int:
        """Numbers of memory per episode: integral and error before, last action, earlier frames."""
        return 2 * self.integral + self.last_action + self.past * self.frame(d)

    def size(self, d: int) -> int:
        """Numbers of the signals."""
        return self.frame(d) * (1 + self.past) + self.integral

    def see(self, observations: Array, memory: Array, fresh: NDArray[np.bool_]) -> Array:
        """Signals (N, s). `memory` (N, m) is updated in place; where `fresh` (N,) the episode begins and the old one is void."""
        count, frame = len(observations), self.frame(observations.shape[1])
        memory[fresh] = 0.0
        total, action, frames = np.split(memory, np.cumsum([2 * self.integral, int(self.last_action)]), axis=1)
        now = np.hstack([self.view(observations), action])
        if self.past:
            frames.reshape(count, self.past, frame)[fresh] = now[fresh, None]
        parts = [now]
        if self.integral:
            error = layout.output_derivatives(observations)[:, 0] - layout.reference(observations)[:, 0]
            total[:, 0] += np.where(fresh, 0.0, self.dt * (total[:, 1] + error) / 2)
            total[:, 1] = error
            parts.append(total[:, :1])
        signals = np.hstack([*parts, frames])
        if self.past:
            frames[:] = np.hstack([now, frames[:, :-frame]])
        return signals

    def acted(self, action: Array, memory: Array) -> None:
        """Remember the action (N,) that followed what was seen last."""
        if self.last_action:
            memory[:, 2 * self.integral] = action


def observer(words: tuple[str, ...]) -> Observer:
    """From the command line's words: integral, last-action, past:k, output-only. Raises ValueError for others."""
    chosen: dict[str, bool | int] = {}
    for word in words:
        name, colon, count = word.partition(":")
        field = name.replace("-", "_")
        if field in ("integral", "last_action", "output_only") and not colon:
            chosen[field] = True
        elif field == "past" and count.isdecimal():
            chosen[field] = int(count)
        else:
            raise ValueError(f"`observe` must be of integral, last-action, past:k, output-only, got {word!r}.")
    return Observer(**chosen)  # type: ignore[arg-type]
