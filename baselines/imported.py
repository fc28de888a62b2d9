"""What a user names by its module."""

import importlib
import os
import sys
from typing import Any


def module(name: str) -> Any:
    """The module, looked for in the working directory too, last of all. Raises ValueError if there is none."""
    here = os.getcwd()
    sys.path.append(here)
    try:
        return importlib.import_module(name)
    except (ModuleNotFoundError, TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be a module that can be imported from {here}: {error}.") from error
    finally:
        sys.path.remove(here)


def factory(location: str) -> Any:
    """The class or function "module:name". Raises ValueError if there is none."""
    name, _, wanted = location.partition(":")
    found = getattr(module(name), wanted, None)
    if not callable(found):
        raise ValueError(
            f"`{location}` must be a class or function of the module `{name}`, which has no {wanted!r} to call."
        )
    return found
