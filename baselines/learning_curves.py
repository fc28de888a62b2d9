"""Sample efficiency: the learning curves that agents carry, aggregated over their seeds."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from baselines import statistics
from baselines.comparison_summary import number

Curve = dict[int, float]  # timesteps -> median tail RMS, inf where that episode left the region


def curve(name: str, training: Mapping[str, Any]) -> Curve:
    """The curve in an agent's file, empty if there is none. Raises ValueError for one that is not what training writes."""
    rows = training.get("curve", [])
    if not isinstance(rows, list | tuple):
        raise ValueError(f"`curve` of {name} must be a list of rows, got {type(rows).__name__}.")
    found: Curve = {}
    for row in rows:
        steps, error = (row.get("timesteps"), row.get("tail_rms")) if isinstance(row, Mapping) else (None, None)
        error = math.inf if error is None else error
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 0 or not _is_cost(error):
            raise ValueError(f"`curve` of {name} must have rows with timesteps and tail_rms, got another one.")
        found[steps] = float(error)
    return found


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


def _is_cost(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
