"""What the commands share: arguments parsed, errors answered with one sentence and exit code 2."""

import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from rich.console import Console


def run(main: Callable[[Any], None], parse: Callable[[], Any]) -> None:
    """`main(parse())`; what the user got wrong is printed to the standard error, without a traceback."""
    try:
        main(parse())
    except (ValueError, gym.error.Error) as error:
        Console(stderr=True, soft_wrap=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        sys.exit(2)
