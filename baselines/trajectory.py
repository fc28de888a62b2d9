"""What one rollout, or a batch of rollouts, has recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Samples of a closed loop whose input is held over each of the N steps.

    A batch of B episodes has one more axis after time: state (N+1, B, n), control (N, B), terminated (B,). All share
    the clock; an episode that ended before the others is continued by NaN rows.
    """

    time: Array  # (N+1,), s, equidistant
    state: Array  # (N+1, n), x
    output_derivatives: Array  # (N+1, n), xi_n = [y, y', ..., y^(n-1)]
    reference: Array  # (N+1, n+1), [y_d, y_d', ..., y_d^(n)]
    control: Array  # (N,), physical u on [t_k, t_(k+1))
    reward: Array  # (N,)
    terminated: bool | npt.NDArray[np.bool_]  # left the region, in contrast to reached the horizon
    output: Array | None = None  # (N+1,), the true y; None: as measured, output_derivatives[..., 0]

    def __post_init__(self) -> None:
        if self.time.ndim != 1 or self.time.size < 2:
            raise ValueError(f"`time` must have shape (N+1,) with N >= 1, got {self.time.shape}.")
        steps = np.diff(self.time)
        if not (self.dt > 0 and np.allclose(steps, self.dt, rtol=1e-6, atol=0)):
            raise ValueError(f"`time` must be equidistant and increasing, got steps {steps.min()} to {steps.max()}.")
        if self.control.ndim not in (1, 2):
            raise ValueError(f"`control` must have shape (N,) or (N, B), got {self.control.shape}.")
        N, batch = self.time.size - 1, self.control.shape[1:]
        if self.state.ndim != 2 + len(batch):
            raise ValueError(f"`state` must have shape {('N+1', *batch, 'n')}, got {self.state.shape}.")
        n = self.state.shape[-1]
        shapes = {
            "state": (N + 1, *batch, n),
            "output_derivatives": (N + 1, *batch, n),
            "reference": (N + 1, *batch, n + 1),
            "control": (N, *batch),
            "reward": (N, *batch),
            "terminated": batch,
        }
        if self.output is not None:
            shapes["output"] = (N + 1, *batch)
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"`{name}` must have shape {shape}, got {np.shape(getattr(self, name))}.")
        over = np.isnan(self.reward)
        if over[0].any() or (over[:-1] & ~over[1:]).any():
            raise ValueError(f"`reward` may be NaN only after an episode's end, got {over.sum()} NaN of {over.size}.")
        if (np.isnan(self.control) != over).any():
            raise ValueError("`control` must be NaN exactly where `reward` is, got NaN elsewhere.")

    @property
    def dt(self) -> float:
        """Sampling time, s."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    @property
    def error(self) -> Array:
        """Tracking error y - y_d of the true y, shape (N+1, ...)."""
        output = self.output_derivatives[..., 0] if self.output is None else self.output
        return output - self.reference[..., 0]

    @property
    def steps(self) -> int | npt.NDArray[np.int64]:
        """Number of steps taken: an int, or shape (B,)."""
        taken = (~np.isnan(self.reward)).sum(axis=0)
        return int(taken) if self.reward.ndim == 1 else taken

    def episodes(self) -> Iterator[Trajectory]:
        """Each episode alone, cut to its own length."""
        for i, N in enumerate(np.atleast_1d(self.steps)):
            own = () if self.control.ndim == 1 else (i,)
            samples, holds = (slice(N + 1), *own), (slice(N), *own)
            yield Trajectory(
                time=self.time[: N + 1],
                state=self.state[samples],
                output_derivatives=self.output_derivatives[samples],
                reference=self.reference[samples],
                control=self.control[holds],
                reward=self.reward[holds],
                terminated=bool(np.atleast_1d(self.terminated)[i]),
                output=None if self.output is None else self.output[samples],
            )
