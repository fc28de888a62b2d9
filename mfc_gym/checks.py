"""What is asked of arguments: each check gives the value back in its plain form or says what is wrong with it."""

import math
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def one_of(name: str, value: object, known: Iterable[str]) -> None:
    if value not in tuple(known):
        raise ValueError(f"`{name}` must be one of {sorted(map(str, known))}, got {value!r}.")


def positive(name: str, value: float, or_zero: bool = False) -> float:
    number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not number or value < 0 or (value == 0 and not or_zero):
        raise ValueError(f"`{name}` must be {'>= 0' if or_zero else 'positive'} and finite, got {value!r}.")
    return float(value)


def vector(name: str, value: Any, size: int, num_envs: int | None = None) -> Array:
    """Shape (size,); with `num_envs` also (num_envs, size), one vector for each environment."""
    try:
        found = np.array(value)
    except ValueError:  # ragged
        found = np.array(None)
    fits = found.shape == (size,) or (num_envs is not None and found.shape == (num_envs, size))
    if not fits or found.dtype.kind not in "iuf" or not np.isfinite(found).all():
        each = "" if num_envs is None else f", or {num_envs} times {size}"
        raise ValueError(f"`{name}` must be {size} finite numbers{each}, got {value!r}.")
    return np.asarray(found, dtype=float)


def mapping(name: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ValueError(f"`{name}` must be a dict, got {value!r}.")
    return dict(value)
