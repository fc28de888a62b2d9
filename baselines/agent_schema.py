"""What the JSON of an agent file may contain, and nothing else."""

import json
import math
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

from baselines import registry
from baselines.observer import MAX_PAST
from baselines.policy_network import ACTIVATIONS, OUTPUTS

Check = Callable[[str, Any], None]

FORMAT = "mfc-gym agent 2"
FIRST_FORMAT = "mfc-gym agent 1"  # without `observe` and `base`
ALGORITHMS = ("PPO", "SAC", "TD3", "TQC", "CrossQ")
MAX_DEPTH = 8
MAX_ROWS = 1000  # features
MAX_WIDTH = 4096  # units of a layer
MAX_LAYERS = 8  # hidden ones
MAX_LIST = 16  # entries of a controller's option


def parse(name: str, data: bytes) -> Any:
    """JSON without NaN, duplicate keys or nesting beyond reason. Raises ValueError for anything else."""
    try:
        return json.loads(data.decode("utf-8"), parse_constant=_refuse, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} must hold JSON, got {str(error).splitlines()[0]}.") from error


def check(name: str, value: Any, schema: Mapping[str, Any] | Check) -> None:
    """Compare a value with a schema: a function that raises ValueError, or a mapping with exactly the keys of the value."""
    if callable(schema):
        schema(name, value)
        return
    if not isinstance(value, dict) or set(value) != set(schema):
        got = sorted(map(str, value))[:20] if isinstance(value, dict) else _short(value)
        raise ValueError(f"{name} must have the keys {sorted(schema)}, got {got}.")
    for key, inner in schema.items():
        check(f"{name}.{key}", value[key], inner)


def one_of(known: Collection[str]) -> Check:
    """A name of a table."""

    def function(name: str, value: Any) -> None:
        if not isinstance(value, str) or value not in known:
            raise ValueError(f"{name} must be one of {sorted(known)}, got {_short(value)}.")

    return function


def matching(pattern: str) -> Check:
    """Text of a pattern."""

    def function(name: str, value: Any) -> None:
        if not isinstance(value, str) or not re.fullmatch(pattern, value):
            raise ValueError(f"{name} must be text like {pattern}, got {_short(value)}.")

    return function


def numbers(name: str, value: Any) -> None:
    """A list of finite numbers."""
    if not isinstance(value, list) or not 1 <= len(value) <= MAX_ROWS or not all(map(_is_number, value)):
        raise ValueError(f"{name} must be a list of at most {MAX_ROWS} finite numbers, got {_short(value)}.")


def rows(name: str, value: Any) -> None:
    """A list of lists of finite numbers."""
    if not isinstance(value, list) or not 1 <= len(value) <= MAX_ROWS:
        raise ValueError(f"{name} must be a list of at most {MAX_ROWS} rows, got {_short(value)}.")
    for i, row in enumerate(value):
        numbers(f"{name}[{i}]", row)


def width(name: str, value: Any) -> None:
    """Number of units of a layer."""
    integer(1, MAX_WIDTH)(name, value)


def widths(name: str, value: Any) -> None:
    """Numbers of units of the hidden layers."""
    if not isinstance(value, list) or len(value) > MAX_LAYERS:
        raise ValueError(f"{name} must be a list of at most {MAX_LAYERS} widths, got {_short(value)}.")
    for i, units in enumerate(value):
        width(f"{name}[{i}]", units)


def plain(name: str, value: Any, depth: int = 0, text: str = r"[^\x00-\x1f]{0,2000}") -> None:
    """Numbers, text, true, false, null, and lists and objects of these, not nested deeply."""
    if depth > MAX_DEPTH:
        raise ValueError(f"{name} must be nested at most {MAX_DEPTH} deep, got more.")
    if isinstance(value, dict):
        for key, inner in value.items():
            matching(r"[\w.\-]{1,100}")(f"key of {name}", key)
            plain(f"{name}.{key}", inner, depth + 1, text)
    elif isinstance(value, list | tuple):
        for inner in value:
            plain(f"{name}[]", inner, depth + 1, text)
    elif isinstance(value, str):
        matching(text)(name, value)
    elif value is not None and not isinstance(value, bool) and not _is_number(value):
        raise ValueError(f"{name} must be plain data, got {_short(value)}.")


def options(name: str, value: Any) -> None:
    """Keywords of an environment; text only as bare names, neither folders nor modules."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be an object, got {_short(value)}.")
    plain(name, value, text=r"\w[\w.\-]{0,99}")


def boolean(name: str, value: Any) -> None:
    """true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {_short(value)}.")


def integer(low: int, high: int) -> Check:
    """An integer from low to high."""

    def function(name: str, value: Any) -> None:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError(f"{name} must be an integer from {low} to {high}, got {_short(value)}.")

    return function


def number(low: float, high: float) -> Check:
    """A number in (low, high]."""

    def function(name: str, value: Any) -> None:
        if not _is_number(value) or not low < value <= high:
            raise ValueError(f"{name} must be a number in ({low}, {high}], got {_short(value)}.")

    return function


def controller_options(name: str, value: Any) -> None:
    """Options of a controller: numbers, bare names, short lists of numbers and of such lists."""
    options(name, value)
    if len(value) > MAX_LIST:
        raise ValueError(f"{name} must have at most {MAX_LIST} keys, got {len(value)}.")
    for key, given in value.items():
        _short_lists(f"{name}.{key}", given)


def _short_lists(name: str, value: Any) -> None:
    if isinstance(value, dict) or (isinstance(value, list) and len(value) > MAX_LIST):
        raise ValueError(f"{name} must be a number, a name or at most {MAX_LIST} of these, got {_short(value)}.")
    for inner in value if isinstance(value, list) else ():
        _short_lists(f"{name}[]", inner)


def fading(name: str, value: Any) -> None:
    """A short list of positive numbers."""
    if not isinstance(value, list | tuple) or len(value) > MAX_LIST:
        raise ValueError(f"{name} must be a list of at most {MAX_LIST} numbers, got {_short(value)}.")
    for width in value:
        number(0.0, 1e9)(f"{name}[]", width)


def optional(schema: Mapping[str, Any]) -> Check:
    """null, or what the schema says."""

    def function(name: str, value: Any) -> None:
        if value is not None:
            check(name, value, schema)

    return function


FIRST_SCHEMA: dict[str, Any] = {
    "format": one_of((FIRST_FORMAT,)),
    "algorithm": one_of(ALGORITHMS),
    "network": {
        "hidden": widths,
        "actions": width,
        "activation": one_of(ACTIVATIONS),
        "output": one_of(OUTPUTS),
    },
    "features": {"matrix": rows, "offset": numbers},
    "environment": {"id": matching(r"mfc_gym/\w{1,100}-v\d{1,3}"), "options": options},
    "training": plain,
    "weights": {"sha256": matching("[0-9a-f]{64}")},
}
SCHEMA: dict[str, Any] = FIRST_SCHEMA | {
    "format": one_of((FORMAT,)),
    "observe": {
        "integral": boolean,
        "last_action": boolean,
        "past": integer(0, MAX_PAST),
        "output_only": boolean,
        "dt": number(0.0, 1e6),
    },
    "base": optional(
        {
            "controller": one_of(registry.names()),
            "options": controller_options,
            "bound": number(0.0, 1.0),
            "fade": fading,
        }
    ),
}
SCHEMAS = {FIRST_FORMAT: FIRST_SCHEMA, FORMAT: SCHEMA}


def check_agent(description: Any) -> None:
    """Compare a description with the schema of the format that it states. Raises ValueError."""
    stated = description.get("format") if isinstance(description, dict) else None
    known = isinstance(stated, str) and stated in SCHEMAS
    check("agent", description, SCHEMAS[str(stated)] if known else SCHEMA)


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300 and math.isfinite(value)
    )


def _short(value: Any) -> str:
    text = type(value).__name__ if isinstance(value, dict | list) else repr(value)
    return text if len(text) <= 100 else text[:100] + "..."


def _refuse(constant: str) -> None:
    raise ValueError(f"the constant {constant}")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key that occurs twice")
    return found
