"""Perturbed flat systems as Gymnasium environments with a tracking reward."""

from mfc_gym.registration import register, register_system
from mfc_gym.systems import SYSTEMS

__all__ = ["ENV_IDS", "register_system"]

ENV_IDS = tuple(register(_name, system=_name) for _name in SYSTEMS)

register("Plant")  # any plant: system = a plant file, or "module:function"
