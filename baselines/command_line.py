"""What the commands share: arguments parsed, errors answered with one sentence and exit code 2."""

import sys
from collections.abc import Callable
from textwrap import indent
from typing import Any

import gymnasium as gym
from rich.console import Console


def description(docstring: str | None) -> str:
    """A module's docstring as the help shows it: the first line, and the examples as they are, which tyro would join."""
    first, _, examples = (docstring or "").strip().partition("\n\n")
    return f"{first}\n{indent(examples, '  ')}"


def run(main: Callable[[Any], None], parse: Callable[[], Any]) -> None:
    """`main(parse())`; what the user got wrong is printed to the standard error, without a traceback."""
    try:
        main(parse())
    except (ValueError, gym.error.Error) as error:
        Console(stderr=True, soft_wrap=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        sys.exit(2)
