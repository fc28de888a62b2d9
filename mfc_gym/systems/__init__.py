"""The plants by name. A new plant is one line here; its equations are imported when it is first built."""

SYSTEMS: dict[str, str] = {
    "PerturbedChain": "mfc_gym.systems.perturbed_chain:perturbed_chain",
    "FlexibleJoint": "mfc_gym.systems.flexible_joint:flexible_joint",
    "MotorPendulum": "mfc_gym.systems.motor_pendulum:motor_pendulum",
    "ElectricFlexibleJoint": "mfc_gym.systems.electric_flexible_joint:electric_flexible_joint",
    "TwoMassSpring": "mfc_gym.systems.two_mass_spring:two_mass_spring",
    "GenesioTesi": "mfc_gym.systems.genesio_tesi:genesio_tesi",
    "Rossler": "mfc_gym.systems.rossler:rossler",
    "Chua": "mfc_gym.systems.chua:chua",
    "VanDerPol": "mfc_gym.systems.van_der_pol:van_der_pol",
    "Duffing": "mfc_gym.systems.duffing:duffing",
    "MagneticLevitation": "mfc_gym.systems.magnetic_levitation:magnetic_levitation",
    "CSTR": "mfc_gym.systems.cstr:cstr",
}
