"""The stated error per control step is met, and a step that no number of substeps can make accurate is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plants import integrated
from scipy.integrate import solve_ivp

from mfc_gym import plant
from mfc_gym.substeps import CANDIDATES, choose_substeps

Array = NDArray[np.float64]


def worst_error(built: plant.Plant, dt: float, m: int, input_limit: float, rng: np.random.Generator) -> float:
    """Of m substeps against DOP853, relative to max(1, abs(x)), over 40 points that stay inside."""
    low, high = built.region(input_limit)
    worst = 0.0
    for _ in range(40):
        x = low + (high - low) * rng.beta(0.3, 0.3, built.order)  # near the faces, where the plant is fastest
        theta = np.where(rng.random(len(built.theta)) < 0.5, *built.theta_set)
        u = input_limit * rng.choice([-1.0, 1.0])
        end = integrated(built.kernel, x, theta, u, dt / m, m, low, high)

        def field(t: float, z: Array, theta: Array = theta, u: float = u) -> Array:
            flow = built.kernel.flow_at(z, theta)
            return flow[: z.size] + u * flow[z.size : 2 * z.size]

        if end[-1]:
            exact = solve_ivp(field, (0, dt), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
            worst = max(worst, (np.abs(end[:-1] - exact) / np.maximum(1, np.abs(exact))).max())
    return worst


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
@pytest.mark.parametrize("order", [2, 3, 5])
def test_error_per_control_step(order: int, dt: float, rng: np.random.Generator) -> None:
    built = plant.load("PerturbedChain", order=order)
    m = choose_substeps(built, built.parameter_set, dt, 50.0, 1e-8)
    assert worst_error(built, dt, m, 50.0, rng) <= 1e-8


@pytest.mark.parametrize("name", ["FlexibleJoint", "MotorPendulum", "Chua"])
def test_error_of_other_plants(name: str, rng: np.random.Generator) -> None:
    built = plant.load(name)
    task = built.task
    m = choose_substeps(built, built.parameter_set, task.dt, task.input_limit, 1e-8)
    assert worst_error(built, task.dt, m, task.input_limit, rng) <= 1e-8


def test_no_more_than_needed(rng: np.random.Generator) -> None:
    """Half the substeps have 16 times the error: more than the tolerance, although the margin is 2."""
    built = plant.load("PerturbedChain")
    m = choose_substeps(built, built.parameter_set, 0.02, 50.0, 1e-8)
    assert worst_error(built, 0.02, m // 2, 50.0, rng) > 1e-8


def test_tolerance_and_step() -> None:
    """Error ~ (dt / m)^4 dt: 10^4 times the accuracy costs 10 times the substeps, up to the gaps between the candidates."""
    built = plant.load("PerturbedChain")
    fine, coarse = (choose_substeps(built, built.parameter_set, 0.02, 50.0, tolerance) for tolerance in (1e-10, 1e-6))
    assert {fine, coarse} <= set(CANDIDATES)
    assert 10 / 1.5 <= fine / coarse <= 10 * 1.5  # two candidates differ by a factor of up to 1.5
    counts = [choose_substeps(built, built.parameter_set, dt, 50.0, 1e-8) for dt in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)]
    assert counts == sorted(counts)


@pytest.mark.parametrize(("dt", "tolerance"), [(2.0, 1e-8), (0.01, 1e-30)])
def test_refused(dt: float, tolerance: float) -> None:
    """2 s: most trajectories leave within 2/1024 s or cannot be resolved; 1e-30 is below the rounding error."""
    built = plant.load("PerturbedChain")
    with pytest.raises(
        ValueError, match=f"`dt` must be small enough for an error of {tolerance:g} within 1024 substeps"
    ):
        choose_substeps(built, built.parameter_set, dt, 50.0, tolerance)
