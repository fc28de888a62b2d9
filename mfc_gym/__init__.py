"""Perturbed flat systems as Gymnasium environments with a tracking reward."""

import gymnasium as gym

from mfc_gym.systems import SYSTEMS

for _name in SYSTEMS:
    gym.register(
        id=f"mfc_gym/{_name}-v0",
        entry_point="mfc_gym.env:TrackingEnv",
        vector_entry_point="mfc_gym.vector_env:TrackingVectorEnv",
        kwargs={"system": _name},
    )

gym.register(  # any plant: system = a plant file, or "module:function"
    id="mfc_gym/Plant-v0",
    entry_point="mfc_gym.env:TrackingEnv",
    vector_entry_point="mfc_gym.vector_env:TrackingVectorEnv",
)

ENV_IDS = tuple(f"mfc_gym/{_name}-v0" for _name in SYSTEMS)
