"""A plant from a TOML file, which may come from anywhere: checked entry by entry, refused with the line that is wrong.

Nothing in the file is ever evaluated, and no content makes the checks run long. See docs/plants for examples.
"""

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mfc_gym import plant_entries as read
from mfc_gym.complexity import check_derivatives
from mfc_gym.enclosure import check_bounds, check_domain, derive_bounds, region_box
from mfc_gym.flat_system import BOUNDS, FlatSystem
from mfc_gym.plant_entries import EntryError, Key
from mfc_gym.toml_lines import line_numbers

SIZE = 65_536  # bytes
DOTS = 300  # per line: the time to read a dotted key grows with the square of its length
STATES, THETA = 12, 8  # at most
BUDGET = 100_000  # interval operations per bound
REQUIRED = ("name", "state", "f", "g", "Delta", "h")
TABLES = ("parameters", "theta", "region", "bounds", "task")


def load_plant(path: str | os.PathLike[str]) -> FlatSystem:
    """The plant that the file at `path` declares, its bounds proved or derived.

    Raises ValueError, one sentence that begins with the path and where possible the line, for anything that is wrong with it.
    """
    text = _text(Path(path))
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"{path}: the file is nested too deeply.") from None
    except ValueError as error:
        found = re.search(r"at line (\d+)", str(error))
        place = f", line {found.group(1)}" if found else ""
        reason = re.sub(r" \(at .*\)", "", str(error))[:200]
        raise ValueError(f"{path}{place}: this is not valid TOML: {reason}.") from None
    try:
        return _system(data)
    except ValueError as error:
        entry = error.path if isinstance(error, EntryError) else _entry(str(error), data)
        lines = line_numbers(text)
        line = next((lines[entry[:k]] for k in range(len(entry), 0, -1) if entry[:k] in lines), None)
        place = "" if line is None else f", line {line}"
        raise ValueError(f"{path}{place}: {error}") from None


def _text(path: Path) -> str:
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file.")
    try:
        with path.open("rb") as file:
            content = file.read(SIZE + 1)
    except OSError as error:
        raise ValueError(f"{path}: the file cannot be read: {error.strerror}.") from None
    if len(content) > SIZE:
        raise ValueError(f"{path}: a plant file may have {SIZE} bytes, this one has more.")
    for i, row in enumerate(content.split(b"\n"), start=1):
        if row.count(b".") > DOTS:
            raise ValueError(f"{path}, line {i}: a line may have {DOTS} dots, this one has {row.count(b'.')}.")
    try:
        return content.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: the file is not text in UTF-8.") from None


def _entry(message: str, data: Mapping[str, Any]) -> Key:
    """The path of the entry that a message about the whole system is about: `key`, `key` entry 2, or `table` ... name."""
    match = re.match(r"`(\w+)`(?: entry (\d+))?", message)
    if match is None:
        return ()
    key, entry = match.groups()
    if entry is not None:
        return (key, int(entry) - 1)
    table = data.get(key)
    names = table if isinstance(table, dict) else {}
    return next(((key, name) for name in names if re.search(rf"\b{re.escape(name)}\b", message)), (key,))


def _system(data: dict[str, Any]) -> FlatSystem:
    read.keys(data, (*REQUIRED, *TABLES))
    for key in REQUIRED:
        if key not in data:
            raise EntryError((), f"the entry `{key}` is missing, a plant needs {', '.join(REQUIRED)}.")
    tables = {key: read.table(data.get(key, {}), (key,)) for key in TABLES}
    state = read.items(data["state"], ("state",))
    if not 2 <= len(state) <= STATES:
        raise EntryError(("state",), f"`state` must have 2 to {STATES} entries, got {len(state)}.")
    if len(tables["theta"]) > THETA:
        raise EntryError(("theta",), f"`theta` must have at most {THETA} entries, got {len(tables['theta'])}.")
    read.identifiers(
        [*state, *tables["parameters"], *tables["theta"]],
        [*(("state", i) for i in range(len(state))), *((t, k) for t in ("parameters", "theta") for k in tables[t])],
    )
    parameters = {k: read.number(v, ("parameters", k)) for k, v in tables["parameters"].items()}
    theta = {k: read.interval(v, ("theta", k)) for k, v in tables["theta"].items()}
    read.keys(tables["region"], state, ("region",))
    read.keys(tables["bounds"], BOUNDS, ("bounds",))
    f, g, Delta = (
        tuple(
            read.expression(e, (key, i), [*state, *(theta if key == "Delta" else ())], parameters)
            for i, e in enumerate(read.items(data[key], (key,), len(state)))
        )
        for key in ("f", "g", "Delta")
    )
    h = read.expression(data["h"], ("h",), state, parameters)
    region = {
        k: tuple(read.region_end(e, ("region", k, i)) for i, e in enumerate(read.items(v, ("region", k), 2)))
        for k, v in tables["region"].items()
    }
    bounds = {k: read.expression(v, ("bounds", k), state, parameters) for k, v in tables["bounds"].items()}
    task = read.task(tables["task"], state, theta)
    symbols = [read.expression(s, ("state", i), state, {}) for i, s in enumerate(state)]
    check_derivatives(f, g, h, Delta, symbols)
    system = FlatSystem(
        name=read.text(data["name"], ("name",)),
        state=tuple(state),
        f=f,
        g=g,
        h=h,
        Delta=Delta,
        parameters=parameters,
        theta=theta,
        region=region,
        bounds=bounds,
        task=task,
    )
    _check_initial_state(system)
    check_domain(system)
    check_bounds(system, budget=BUDGET)
    return system if set(bounds) == set(BOUNDS) else replace(system, bounds=derive_bounds(system))


def _check_initial_state(system: FlatSystem) -> None:
    region = dict(zip(system.state, region_box(system).values(), strict=True))
    task = system.task
    for i, (name, value) in enumerate(zip(system.state, task.initial_state or (), strict=False)):
        if not region[name][0] <= value <= region[name][1]:
            raise EntryError(
                ("task", "initial_state", i), f"`initial_state` must lie in the region, got {name} = {value}."
            )
    for name, (low, high) in task.initial_set.items():
        if not region[name][0] <= low < high <= region[name][1]:
            raise EntryError(
                ("task", "initial_set", name), f"`initial_set` must lie in the region, got [{low}, {high}]."
            )
