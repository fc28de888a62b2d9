"""What is said where an optional package is missing."""

import gymnasium as gym


def missing(package: str | None, extra: str) -> gym.error.DependencyNotInstalled:
    """The error that names the command to run."""
    return gym.error.DependencyNotInstalled(
        f'{package} is not installed, run `pip install -c constraints.txt -e ".[{extra}]"`'
    )
