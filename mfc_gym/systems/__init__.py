"""The plants by name. A new plant is one line here; its equations are imported when it is first built."""

SYSTEMS: dict[str, str] = {
    "PerturbedChain": "mfc_gym.systems.perturbed_chain:perturbed_chain",
}
