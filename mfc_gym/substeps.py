"""How many Runge-Kutta steps a control step takes: from a stated error, not by habit."""

import numpy as np
from numpy.typing import NDArray

from mfc_gym.plant import Plant

Array = NDArray[np.float64]
CANDIDATES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)
SAMPLES = 256
MARGIN = 2.0  # the worst of 20 000 points had up to 1.7 times the error of the worst sample


def choose_substeps(
    plant: Plant, parameter_set: tuple[Array, Array], dt: float, input_limit: float, tolerance: float
) -> int:
    """The fewest substeps with an error below `tolerance` (relative to max(1, abs(x))) per control step.

    The error of m substeps is estimated against 2 m (Richardson: times 16/15) at points of the operating region, most
    of them near its faces, at the corners of the theta set and at both input limits. A trajectory that leaves the
    region is compared over the longest of m, m/2, m/4 ... substeps that it stays. Raises ValueError if 1024 substeps
    are not enough, also because more than half of the trajectories leave within one substep.
    """
    rng = np.random.default_rng(0)
    low, high = plant.region(input_limit)
    p = len(plant.parameters)
    states = low + (high - low) * rng.beta(0.3, 0.3, (SAMPLES, plant.order))
    thetas = np.where(rng.random((SAMPLES, p)) < 0.5, *parameter_set)
    inputs = input_limit * np.where(np.arange(SAMPLES) % 2, 1.0, -1.0)

    def error(m: int) -> float:
        worst, compared = 0.0, 0
        for x, theta, u in zip(states, thetas, inputs, strict=True):
            k = m
            while k > 0:
                coarse = plant.kernel.integrate_at(x, theta, u, dt / m, k, low, high)
                fine = plant.kernel.integrate_at(x, theta, u, dt / (2 * m), 2 * k, low, high)
                if coarse[-1] and fine[-1]:
                    worst = max(worst, float((np.abs(coarse - fine) / np.maximum(1.0, np.abs(fine))).max()))
                    compared += 1
                    break
                k //= 2
        return 16 / 15 * MARGIN * worst if 2 * compared >= SAMPLES else np.inf

    for m in CANDIDATES:
        if error(m) <= tolerance:
            return m
    raise ValueError(
        f"`dt` must be small enough for an error of {tolerance:g} within {CANDIDATES[-1]} substeps, got {dt}."
    )
