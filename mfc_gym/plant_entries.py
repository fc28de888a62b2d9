"""The entries of a plant file, each read with its type and range; what is wrong with one is said at its path."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from keyword import iskeyword
from typing import Any

import sympy as sp

from mfc_gym.expressions import FUNCTIONS, parse, reason_against
from mfc_gym.flat_system import INPUT_LIMIT
from mfc_gym.task import Task

LARGEST = 1e30
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
RESERVED = {*FUNCTIONS, "pi", "input_limit", "u", "t"}

Key = tuple[str | int, ...]
Interval = tuple[float, float]


class EntryError(ValueError):
    """What is wrong with the entry at `path`."""

    def __init__(self, path: Key, message: str) -> None:
        super().__init__(message)
        self.path = path


def keys(table: Mapping[str, Any], allowed: Collection[str], path: Key = ()) -> None:
    """Refuse the keys that are not `allowed`."""
    for key in table:
        if key not in allowed:
            where = f"[{path[0]}]" if path else "a plant file"
            raise EntryError((*path, key), f"{key[:40]!a} is no key of {where}, which may have {', '.join(allowed)}.")


def table(value: Any, path: Key, largest: int = 64) -> dict[str, Any]:
    if not isinstance(value, dict) or len(value) > largest:
        raise EntryError(path, f"{_label(path)} must be a table of at most {largest} entries, got {_short(value)}.")
    return value


def items(value: Any, path: Key, length: int | None = None) -> list[Any]:
    if not isinstance(value, list) or (length is not None and len(value) != length):
        got = f"{len(value)} entries" if isinstance(value, list) else _short(value)
        wanted = f"a list of {length} entries" if length is not None else "a list"
        raise EntryError(path, f"{_label(path)} must be {wanted}, got {got}.")
    return value


def text(value: Any, path: Key) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 80 or not (value.isascii() and value.isprintable()):
        raise EntryError(path, f"{_label(path)} must be a text of 1 to 80 ASCII characters, got {_short(value)}.")
    return value


def number(value: Any, path: Key, positive: bool = False) -> float:
    real = isinstance(value, int | float) and not isinstance(value, bool)
    if not real or not abs(value) <= LARGEST or (positive and value <= 0):
        wanted = "a positive number" if positive else "a number"
        raise EntryError(path, f"{_label(path)} must be {wanted} of moderate size, got {_short(value)}.")
    return float(value)


def interval(value: Any, path: Key) -> Interval:
    low, high = (number(end, (*path, i)) for i, end in enumerate(items(value, path, 2)))
    if not low < high:
        raise EntryError(path, f"{_label(path)} must be an interval [low, high] with low < high, got [{low}, {high}].")
    return low, high


def identifiers(names: Sequence[Any], paths: Sequence[Key]) -> list[str]:
    """Names that are plain, distinct and not taken."""
    known: set[str] = set()
    for name, path in zip(names, paths, strict=True):
        if not isinstance(name, str) or not NAME.fullmatch(name) or iskeyword(name) or "__" in name:
            raise EntryError(path, f"a name must be a letter followed by letters, digits or _, got {_short(name)}.")
        if name in RESERVED:
            raise EntryError(path, f"{name!r} is a function or reserved, it cannot name anything else.")
        if name in known:
            raise EntryError(path, f"the name {name!r} stands for two things, names must be distinct.")
        known.add(name)
    return list(names)


def expression(value: Any, path: Key, names: Collection[str], values: Mapping[str, float]) -> sp.Expr:
    """An expression in `names`, the known `values` put in."""
    if not isinstance(value, str):
        return sp.Rational(str(number(value, path)))
    try:
        parsed = parse(value, [*names, *values])
    except ValueError as error:
        raise EntryError(path, f"{_label(path)}: {error}") from None
    known = parsed.subs({sp.Symbol(name, real=True): sp.Rational(str(v)) for name, v in values.items()})
    reasons = map(reason_against, sp.preorder_traversal(known)) if values else ()
    if reason := next(filter(None, reasons), None):
        raise EntryError(path, f"{_label(path)} with the values of its parameters: {reason}.")
    return known


def region_end(value: Any, path: Key) -> sp.Expr:
    """A number, or an expression in input_limit."""
    parsed = expression(value, path, ["input_limit"], {})
    return parsed.subs(sp.Symbol("input_limit", real=True), INPUT_LIMIT)


def task(value: Any, states: Sequence[str], theta: Mapping[str, Interval]) -> Task:
    """The table [task], every key as in `Task`; numbers but the offset are positive."""
    entries = table(value, ("task",))
    defaults = {f.name: f.default for f in fields(Task)}
    keys(entries, list(defaults), ("task",))
    read: dict[str, Any] = {}
    for key, entry in entries.items():
        path = ("task", key)
        if key in ("theta", "initial_state"):
            length = len(theta) if key == "theta" else len(states)
            read[key] = tuple(number(v, (*path, i)) for i, v in enumerate(items(entry, path, length)))
        elif key == "initial_set":
            keys(table(entry, path), states, path)
            read[key] = {state: interval(ends, (*path, state)) for state, ends in entry.items()}
        elif key == "reference_parameters":
            read[key] = {name: number(v, (*path, name)) for name, v in table(entry, path).items()}
        elif isinstance(defaults[key], str):
            read[key] = text(entry, path)
        else:
            read[key] = number(entry, path, positive=key != "reference_offset")
    for i, (given, (name, (low, high))) in enumerate(zip(read.get("theta", ()), theta.items(), strict=False)):
        if not low <= given <= high:
            raise EntryError(
                ("task", "theta", i), f"`theta` must lie in its set, {name} = {given} not in [{low}, {high}]."
            )
    return Task(**read)


def _label(path: Key) -> str:
    return f"`{path[-2]}` entry {path[-1] + 1}" if isinstance(path[-1], int) else f"`{path[-1]}`"


def _short(value: Any) -> str:
    shown = ascii(value) if not isinstance(value, int) or abs(value) < 10**40 else "an integer of many digits"
    return shown if len(shown) <= 60 else shown[:57] + "..."
