"""The environments' ids: `mfc_gym/NAME-v0` for every plant of the library and for plants of your own."""

import re
from typing import TYPE_CHECKING

import gymnasium as gym

from mfc_gym import systems

if TYPE_CHECKING:
    from mfc_gym.flat_system import FlatSystem

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def register(name: str, **options: str) -> str:
    """Makes `mfc_gym/NAME-v0` known to Gymnasium; returns the id."""
    env_id = f"mfc_gym/{name}-v0"
    gym.register(
        id=env_id,
        entry_point="mfc_gym.env:TrackingEnv",
        vector_entry_point="mfc_gym.vector_env:TrackingVectorEnv",
        kwargs=options,
    )
    return env_id


def register_system(name: str, system: "FlatSystem") -> str:
    """A plant of your own as `mfc_gym/NAME-v0`, in this process; returns the id.

    Its domain and bounds are checked as those of a plant file; the bounds it leaves out are derived. Raises ValueError for a
    name that is taken or none, an expression that is not defined in the region, or a bound that does not hold.
    """
    from dataclasses import replace

    from mfc_gym import plant
    from mfc_gym.enclosure import check_bounds, check_domain, derive_bounds
    from mfc_gym.flat_system import FlatSystem

    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"`name` must be a letter followed by letters, digits or _, got {name!r}.")
    if name in systems.SYSTEMS or name == "Plant":
        raise ValueError(f"`name` must not be that of a plant of the library, got {name!r}.")
    if not isinstance(system, FlatSystem):
        raise ValueError(f"`system` must be a mfc_gym.flat_system.FlatSystem, got {system!r}.")
    check_domain(system)
    check_bounds(system)
    complete = replace(system, bounds=derive_bounds(system))
    if name in plant.OWN:
        if plant.OWN[name].text != complete.text:
            raise ValueError(f"`name` must be new, {name!r} is another plant already.")
        return f"mfc_gym/{name}-v0"
    plant.OWN[name] = complete
    return register(name, system=name)
