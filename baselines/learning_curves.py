"""Sample efficiency: the learning curves that agents carry, aggregated over their seeds."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from baselines import statistics
from baselines.comparison_summary import number

Curve = dict[int, float]  # timesteps -> median tail RMS, inf where that episode left the region


def curve(training: Mapping[str, Any]) -> Curve:
    """The curve in an agent's file; empty if there is none, or another one than training writes."""
    rows = training.get("curve")
    if not isinstance(rows, list | tuple) or not all(map(_is_row, rows)):
        return {}
    return {row["timesteps"]: math.inf if row["tail_rms"] is None else float(row["tail_rms"]) for row in rows}


def aggregate(curves: Sequence[Curve], level: float | None, reps: int, seed: int = 0) -> dict[str, Any] | None:
    """Interquartile mean over the trainings with its interval, where all of them have been evaluated; None: nowhere.

    `reached`: the first timesteps at which it is at most 1, 3, 10 and 100 times `level`; None: never.
    """
    common = sorted(set.intersection(*(set(one) for one in curves))) if curves else []
    if not common:
        return None
    errors = np.array([[one[steps] for steps in common] for one in curves])
    found = [statistics.bootstrap(statistics.iqm, column, reps=reps, seed=seed) for column in errors.T]
    data: dict[str, Any] = {"trainings": len(curves), "timesteps": common}
    data |= {part: [number(getattr(one, part)) for one in found] for part in ("value", "low", "high")}
    data["reached"] = {str(factor): _first(common, data["value"], level, factor) for factor in (1, 3, 10, 100)}
    return data


def _first(timesteps: Sequence[int], values: Sequence[float | None], level: float | None, factor: int) -> int | None:
    if level is None:
        return None
    return next((t for t, v in zip(timesteps, values, strict=True) if v is not None and v <= factor * level), None)


def _is_row(row: Any) -> bool:
    if not isinstance(row, Mapping) or not {"timesteps", "tail_rms"} <= set(row):
        return False
    steps, error = row["timesteps"], row["tail_rms"]
    return type(steps) is int and steps >= 0 and (error is None or (type(error) in (int, float) and error >= 0))
