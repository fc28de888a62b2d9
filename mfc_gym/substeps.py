"""How many Runge-Kutta steps a control step takes: from a stated error, not by habit."""

import numpy as np

from mfc_gym.plant import Plant

CANDIDATES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)
SAMPLES = 64


def choose_substeps(plant: Plant, dt: float, input_limit: float, tolerance: float) -> int:
    """The fewest substeps with an error below `tolerance` (relative to max(1, abs(x))) per control step.

    The error of m substeps is estimated against 2 m (Richardson: times 16/15) at points drawn from the operating region, the
    theta set and both input limits. Raises ValueError if 1024 substeps are not enough.
    """
    rng = np.random.default_rng(0)
    low, high = plant.region(input_limit)
    theta_low, theta_high = plant.theta_set
    states = rng.uniform(low, high, (SAMPLES, plant.order))
    thetas = rng.uniform(theta_low, theta_high, (SAMPLES, len(theta_low)))
    inputs = input_limit * np.where(np.arange(SAMPLES) % 2, 1.0, -1.0)

    def end(x: np.ndarray, theta: np.ndarray, u: float, m: int) -> np.ndarray:
        return np.asarray(plant.kernel.integrate_at(x, theta, u, dt / m, m, low, high))

    def error(m: int) -> float:
        worst = 0.0
        for x, theta, u in zip(states, thetas, inputs, strict=True):
            coarse, fine = end(x, theta, u, m), end(x, theta, u, 2 * m)
            if coarse[-1] and fine[-1]:
                worst = max(worst, 16 / 15 * float((np.abs(coarse - fine) / np.maximum(1.0, np.abs(fine))).max()))
        return worst

    for m in CANDIDATES:
        if error(m) <= tolerance:
            return m
    raise ValueError(f"`dt` must be small enough for an error of {tolerance:g} within {CANDIDATES[-1]} substeps, got {dt}.")
