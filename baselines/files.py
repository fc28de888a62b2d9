"""Files that are written whole or not at all."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """`write` fills a file beside `path`, which reaches the disk and then takes its name; one writer at a time."""
    new = path.with_name(f".new.{path.name}")  # always the same: killed writers leave no more than one
    try:
        write(new)
        with new.open("rb+") as file:
            os.fsync(file.fileno())
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def write_json(path: Path, data: Any) -> None:
    """Plain data without NaN or inf."""
    text = json.dumps(data, indent=1, allow_nan=False) + "\n"
    replace(path, lambda target: target.write_text(text))
