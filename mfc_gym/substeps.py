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

    def flow(parts: int, steps: int, chosen: NDArray[np.bool_]) -> Array:
        ends = np.empty((int(chosen.sum()), plant.order + 1))
        plant.kernel.integrate_all(states[chosen], thetas[chosen], inputs[chosen], dt / parts, steps, low, high, ends)
        return ends

    def error(m: int) -> float:
        worst, left, k = 0.0, np.ones(SAMPLES, dtype=bool), m
        while k > 0 and left.any():
            coarse, fine = (flow(parts * m, k * parts, left) for parts in (1, 2))
            inside = (coarse[:, -1] > 0) & (fine[:, -1] > 0)
            differences = np.abs(coarse - fine) / np.maximum(1.0, np.abs(fine))
            worst = max(worst, float(differences[inside].max(initial=0.0)))
            left[np.flatnonzero(left)[inside]] = False
            k //= 2
        return 16 / 15 * MARGIN * worst if 2 * left.sum() <= SAMPLES else np.inf

    for m in CANDIDATES:
        if error(m) <= tolerance:
            return m
    raise ValueError(
        f"`dt` must be small enough for an error of {tolerance:g} within {CANDIDATES[-1]} substeps, got {dt}."
    )
