"""What moves within the sampling interval: against SciPy, against differences of y, and alone against many at once."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import baselines
from mfc_gym.actuator import Actuator
from mfc_gym.env import TrackingEnv

Make = Callable[..., TrackingEnv]
SINE = {"wave": "sine", "amplitude": 0.05, "frequency": 3.0, "phase": 0.4}
LAG = 0.05
MOVING: dict[str, Any] = {
    "theta": (0.2, -0.3),
    "schedule": {"alpha1": SINE},
    "disturbance": {"x1": {**SINE, "amplitude": 0.2}, "u": {"wave": "noise", "rms": 0.3, "bandwidth": 4.0}},
    "actuator": {"lag": LAG},
    "horizon": 2.0,
}
NOISELESS = {**MOVING, "disturbance": {"x1": MOVING["disturbance"]["x1"]}}
DT = 0.01


def sine(t: float, amplitude: float) -> float:
    return amplitude * np.sin(3.0 * t + 0.4)


def test_states_are_those_of_an_independent_integration(make: Make, rng: np.random.Generator) -> None:
    """Below the stated error, 1e-8 per control step, which the unstable chain multiplies by exp(2 |x|) or so: times 100."""
    env = make(**NOISELESS)
    obs, _ = env.reset(seed=0)
    x, lagged = obs[:3], 0.0
    for k in range(40):
        u = float(rng.uniform(-5, 5))
        start = lagged

        def rhs(t: float, x: np.ndarray, u: float = u, start: float = start, begin: float = k * DT) -> list[float]:
            acting = u + (start - u) * np.exp(-(t - begin) / LAG)
            first = (1.2 + sine(t, 0.05)) * x[1] + sine(t, 0.2)
            return [first, 0.7 * x[2], acting + x @ x]

        x = solve_ivp(rhs, (k * DT, (k + 1) * DT), x, rtol=1e-11, atol=1e-13).y[:, -1]
        lagged = u + (start - u) * np.exp(-DT / LAG)
        obs, *_ = env.step([u / 50.0])
        np.testing.assert_allclose(obs[:3], x, rtol=0, atol=1e-6)


def test_output_derivatives_are_those_of_y(make: Make) -> None:
    """Central differences of y and y', error dt^2 / 6 times the next derivative but one (below 300 here)."""
    env = make(**NOISELESS, dt=0.001, initial_state=(0.0, 0.5, 0.0))
    env.reset(seed=0)
    xi_n = np.array([env.step([0.02 * np.sin(0.005 * k)])[0][3:6] for k in range(800)])
    for k in range(2):
        slope = (xi_n[2:, k] - xi_n[:-2, k]) / 0.002
        np.testing.assert_allclose(slope, xi_n[1:-1, k + 1], rtol=0, atol=300 * 1e-6 / 6)


def test_scalar_and_vector_agree_bit_for_bit(rng: np.random.Generator) -> None:
    envs = gym.make_vec("mfc_gym/PerturbedChain-v0", num_envs=3, vectorization_mode="vector_entry_point", **MOVING)
    first, _ = envs.reset(seed=5)
    actions = rng.uniform(-0.2, 0.2, (60, 3, 1))
    found = [first, *(envs.step(a)[0] for a in actions)]
    for i in range(3):
        env = gym.make("mfc_gym/PerturbedChain-v0", **MOVING)
        expected = [env.reset(seed=5 + i)[0], *(env.step(a[i])[0] for a in actions)]
        np.testing.assert_array_equal(np.array(found)[:, i], expected)
    assert not np.array_equal(found[-1][0], found[-1][1])  # each has noise of its own


def test_the_compiled_rollout_gives_the_same_numbers() -> None:
    env = gym.make("mfc_gym/PerturbedChain-v0", **MOVING)
    controller = baselines.make("mfc", env)
    fast, slow = (baselines.rollout(env, controller, seed=1, compiled=compiled) for compiled in (True, False))
    np.testing.assert_array_equal(fast.state, slow.state)


def test_delay_rate_and_quantisation(make: Make) -> None:
    """x3' = u + |x|^2 of a chain at rest shows the input: two samples late, in steps of 0.5, by at most 1 per sample."""
    env = make(actuator={"delay": 2, "quantisation": 0.5, "rate": 1.0 / DT}, initial_state=(0.0, 0.0, 0.0))
    env.reset(seed=0)
    demands = [3.3, 3.3, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0]
    before, inputs = np.zeros(3), []
    for demand in demands:
        x = env.step([demand / 50.0])[0][:3]
        inputs.append((x[2] - before[2]) / DT)
        before = x
    expected = [0.0, 0.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(inputs, expected, rtol=0, atol=5e-3)  # |x|^2 on the way, at most 0.05^2


def test_theta_may_be_set_within_an_episode(make: Make) -> None:
    env = make(**NOISELESS)
    env.reset(seed=0)
    env.step([0.0])
    env.unwrapped.theta = (0.1, -0.1)
    np.testing.assert_allclose(env.unwrapped.theta, (0.1 + sine(DT, 0.05) - 0.0, -0.1), atol=1e-12)
    before = env.unwrapped.theta
    with pytest.raises(ValueError, match=r"`theta` must keep abs\(Delta_3\) <= delta_3"):
        env.unwrapped.theta = (0.9, 0.9)
    np.testing.assert_array_equal(env.unwrapped.theta, before)


def test_theta_of_a_vector_environment() -> None:
    envs = gym.make_vec("mfc_gym/PerturbedChain-v0", num_envs=2, vectorization_mode="vector_entry_point")
    envs.reset(seed=0)
    envs.theta = [(0.1, -0.1), (0.2, -0.2)]
    np.testing.assert_array_equal(envs.theta, [(0.1, -0.1), (0.2, -0.2)])
    x = envs.step(np.zeros((2, 1)))[0]
    np.testing.assert_allclose(x[:, 4], np.array([1.1, 1.2]) * x[:, 1], rtol=1e-15)


@pytest.mark.parametrize(("uncertainty", "factor"), [("nominal", 0.0), ("mild", 0.5), ("hard", 1.0), ("beyond", 1.5)])
def test_uncertainty_sets(make: Make, uncertainty: str, factor: float) -> None:
    fixed = make(uncertainty=uncertainty)
    fixed.reset()
    np.testing.assert_allclose(fixed.theta, factor * np.array([0.5, -0.5]))
    env = make(uncertainty=uncertainty, scenario="random")
    for seed in range(50):
        env.reset(seed=seed)
        assert (np.abs(env.theta) <= 0.5 * factor).all()
        covered = (np.abs(env.theta) <= 0.5).all() and abs((1 + env.theta).prod() - 1) <= 0.25
        assert covered == (uncertainty != "beyond")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uncertainty": "wild"}, "`uncertainty` must be one of"),
        ({"unmatchedness": 2.0}, r"`unmatchedness` must lie in \[0, 1\]"),
        ({"unmatchedness": -0.5}, "`unmatchedness` must be >= 0"),
        ({"schedule": {"gamma": SINE}}, "`schedule` must be of"),
        ({"schedule": {"alpha1": SINE}}, "where it is scheduled to go"),
        ({"disturbance": {"x9": SINE}}, "`disturbance` must enter through"),
        ({"actuator": {"lag": -1.0}}, "`lag` of the actuator must be a number >= 0"),
        ({"actuator": {"delay": 0.5}}, "`delay` of the actuator must be an integer"),
        ({"actuator": {"rate": 0}}, "`rate` of the actuator must be positive"),
        ({"actuator": {"gain": 1}}, "`actuator` must be a dict with keys among"),
    ],
)
def test_errors(make: Make, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_theta_that_is_drawn_need_not_be_the_usual_one() -> None:
    """The chain's usual theta lies on the edge of what is admissible, where nothing may move outwards."""
    env = gym.make("mfc_gym/PerturbedChain-v0", scenario="random", schedule={"alpha1": SINE})
    assert env.reset(seed=0)[0].size == 10


def test_the_default_actuator_is_ideal() -> None:
    assert Actuator.of({}) == Actuator.of(None) == Actuator()


def test_no_exact_solution_of_what_moves() -> None:
    env = gym.make("mfc_gym/PerturbedChain-v0", **NOISELESS)
    with pytest.raises(ValueError, match="must have constant theta and an ideal actuator"):
        baselines.filippov(env, baselines.make("mfc", env))
