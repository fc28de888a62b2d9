"""Switching laws: projections, stability regions, the mean over an interval, orders in the sampling time."""

import gymnasium as gym
import numpy as np
import pytest

import baselines
import mfc_gym  # noqa: F401
from baselines.switching import SWITCHINGS, average, best_rate, implicit, saturation, sign

PAPER = {"initial_model_state": (0.5, 0.0, 0.0), "model_poles": (-1.0,) * 3, "poles": (-4.0,) * 3, "gain": "paper"}


def transition(p: float, rate: float) -> np.ndarray:
    """(sigma, d) near the surface under `implicit-observer`, module docstring of `baselines.switching`."""
    return np.array([[1 - p, -p], [rate * (1 - p), 1 - rate * p]])


def radius(p: float, rate: float) -> float:
    return float(np.abs(np.linalg.eigvals(transition(p, rate))).max())


def test_sign_is_zero_at_zero() -> None:
    assert [sign(s, 0.0, 1.0, 0.0, 2.0, 0.0, 0.1) for s in (-1.0, 0.0, 1.0)] == [2.0, 0.0, -2.0]


def test_saturation_is_linear_inside_the_layer() -> None:
    assert saturation(0.05, 0.0, 1.0, 0.0, 2.0, 0.0, 0.1) == -1.0
    assert saturation(0.5, 0.0, 1.0, 0.0, 2.0, 0.0, 0.1) == -2.0


def test_implicit_solves_the_set_valued_equation() -> None:
    """v in -Gamma Sgn(s_next) with s_next = a + b v: zero next s with abs(v) <= Gamma, or full gain against its sign."""
    rng = np.random.default_rng(0)
    for s, a, b, Gamma in (
        np.abs(rng.normal(size=(1000, 4))) * [1, 3, 1, 1] * rng.choice([-1, 1], (1000, 4)) ** [0, 1, 0, 0]
    ):
        v = implicit(s, a, b, 0.0, Gamma, 0.0, 0.1)
        after = a + b * v
        if abs((s - a) / b) <= Gamma:  # the surface can be kept
            assert abs(v) <= Gamma
            assert abs(after) <= 1e-12 * (1 + abs(a)) or v == -np.sign(after) * Gamma


@pytest.mark.parametrize("s", [0.3, -0.2, 0.01])
@pytest.mark.parametrize("drift", [-3.0, -0.5, 0.0, 0.7, 2.5])
def test_average_is_the_mean_of_the_continuous_time_law(s: float, drift: float) -> None:
    """s' = drift + v_L, v_L in -Gamma Sgn(s), over one unit of time; brute force by 1e4 implicit Euler steps."""
    Gamma, steps = 1.0, 10_000
    value, total = s, 0.0
    for _ in range(steps):
        predicted = value + drift / steps
        v = -np.clip(predicted * steps, -Gamma, Gamma)  # backward Euler: exact up to the step in which s reaches zero
        value = predicted + v / steps
        total += v / steps
    assert average(s, s + drift, 1.0, Gamma, 0.0) == pytest.approx(total, abs=4 * Gamma / steps)


@pytest.mark.parametrize("delta_3", [0.0, 0.1, 0.25, 0.5, 0.9, 0.99])
def test_best_rate_contracts_by_the_square_root_of_delta_3(delta_3: float) -> None:
    """The radius never exceeds sqrt(delta_3) for abs(Delta_3) <= delta_3, and no other rate does better."""
    gains = 1 + delta_3 * np.linspace(-1, 1, 201)
    worst = max(radius(p, best_rate(delta_3)) for p in gains)
    # a double eigenvalue is computed to the square root of the rounding error
    assert worst == pytest.approx(np.sqrt(delta_3), abs=1e-6)
    for rate in np.linspace(0.02, 1, 50):
        assert max(radius(p, rate) for p in gains) >= np.sqrt(delta_3) - 1e-6


@pytest.mark.parametrize("rate", [0.1, 0.5, 1.0])
def test_stability_region_of_the_observer(rate: float) -> None:
    low, high = SWITCHINGS["implicit-observer"].stable(rate)
    inside, outside = np.linspace(low, high, 100)[1:-1], (high * 1.01, -0.01)
    assert all(radius(p, rate) < 1 for p in inside)
    assert all(radius(p, rate) > 1 for p in outside)


@pytest.mark.parametrize("p", [0.02, 0.3, 0.75, 1.0, 1.25, 1.7, 1.98, 2.02, -0.02])
def test_implicit_law_is_stable_exactly_for_input_gains_below_two(p: float) -> None:
    """s_next = s + p b v_L with b = 1: the law contracts by abs(1 - p) per step, as the linear analysis says."""
    s = [1e-6]
    for _ in range(50):
        s.append(s[-1] + p * implicit(s[-1], s[-1], 1.0, 0.0, 1.0, 0.0, 0.1))
    factors = np.array(s[1:]) / np.array(s[:-1]) if p != 1.0 else np.zeros(50)
    assert np.allclose(np.abs(factors), abs(1 - p), rtol=1e-6)
    low, high = SWITCHINGS["implicit"].stable(0.0)
    assert (abs(s[-1]) < abs(s[0])) == (low < p < high)


@pytest.mark.parametrize("switching", ["implicit", "implicit-observer"])
@pytest.mark.parametrize("theta", [-0.8, -0.5, 0.5, 0.8])
def test_closed_loop_is_stable_for_large_Delta_3(switching: str, theta: float) -> None:
    """The chain of order 2 with Delta_3 = theta and rho = 0.85, small motions: tail error O(dt), no oscillation of u."""
    env = gym.make(
        "mfc_gym/PerturbedChain-v0", order=2, rho=0.85, theta=(theta,), initial_state=(0.1, 0.0), dt=0.01, horizon=10.0,
        reference_parameters={"amplitude": 0.2, "frequency": 0.5},
    )  # fmt: skip
    trajectory = baselines.rollout(env, baselines.make("mfc", env, switching=switching))
    assert not trajectory.terminated
    assert np.abs(trajectory.error[500:]).max() < 0.01
    assert np.abs(np.diff(trajectory.control[500:])).sum() / 5.0 < 1.0


def slope(switching: str, design: str, dts: tuple[float, ...]) -> float:
    """Order of max abs(y - y_exact) in dt on the paper's example."""
    errors = []
    for dt in dts:
        env = gym.make("mfc_gym/PerturbedChain-v0", dt=dt, horizon=8.0)
        controller = baselines.make("mfc", env, switching=switching, design=design, **PAPER)
        exact = baselines.filippov(env, controller)
        sampled = baselines.rollout(env, controller)
        errors.append(np.abs(sampled.error - exact.signals(np.minimum(sampled.time, exact.end))["error"]).max())
    return float(np.polyfit(np.log(dts), np.log(errors), 1)[0])


@pytest.mark.parametrize(
    ("switching", "order"), [("sign", 1.0), ("implicit", 1.0), ("implicit-observer", 2.0), ("saturation", 0.0)]
)
def test_order_in_the_sampling_time(switching: str, order: float) -> None:
    """Explicit and implicit sign O(dt), with the estimate O(dt^2); a boundary layer leaves an error that dt does not change."""
    assert slope(switching, "surface", (0.001, 0.002, 0.004, 0.008)) == pytest.approx(order, abs=0.15)


def test_implicit_laws_do_not_chatter() -> None:
    """Variation of the held control against the exact solution's: 1 up to O(dt); the explicit sign: some hundred times."""
    from baselines.exact_metrics import total_variation

    env = gym.make("mfc_gym/PerturbedChain-v0", dt=0.01)
    exact = total_variation(baselines.filippov(env, baselines.make("mfc", env, design="paper", **PAPER)), 10.0, 20.0)
    ratio = {}
    for switching in ("sign", "implicit-observer"):
        control = baselines.rollout(
            env, baselines.make("mfc", env, design="paper", switching=switching, **PAPER)
        ).control
        ratio[switching] = np.abs(np.diff(control[1000:])).sum() / exact
    assert ratio["implicit-observer"] == pytest.approx(1.0, abs=0.02)
    assert ratio["sign"] > 100


@pytest.mark.parametrize("theta", [(-0.13, -0.13), (0.1, 0.13), (0.5, -0.5), (0.0, 0.0)])
@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05])
def test_the_reference_policy_tracks_over_the_admissible_theta(theta: tuple[float, float], dt: float) -> None:
    """From inside the unit ball, at 20 to 1000 Hz: tail error below dt^2 and variation below 1.1 of the exact solution's 1.6."""
    env = gym.make("mfc_gym/PerturbedChain-v0", dt=dt, theta=theta)
    trajectory = baselines.rollout(env, baselines.make("mfc", env), options={"initial_state": [-0.5, 0.5, -0.5]})
    half = len(trajectory.control) // 2
    assert not trajectory.terminated
    assert np.abs(trajectory.error[half:]).max() <= max(dt**2, 1e-6)
    assert np.abs(np.diff(trajectory.control[half:])).sum() / 10.0 <= 3.0


def test_saturation_of_the_input_does_not_wind_up_the_estimate() -> None:
    """Held at the input limit for the first second, the loop still settles as the exact solution with the same limit does."""
    env = gym.make("mfc_gym/PerturbedChain-v0", dt=0.01, input_limit=6.0)
    options = {"initial_state": [0.8, 0.0, 0.0]}
    controller = baselines.make("mfc", env, initial_model_state="reference")
    sampled, exact = (
        baselines.rollout(env, controller, options=options),
        baselines.filippov(env, controller, options=options),
    )
    assert (np.abs(sampled.control[:20]) >= 6.0).any()
    assert not sampled.terminated
    assert not exact.terminated
    difference = sampled.error - exact.signals(np.minimum(sampled.time, exact.end))["error"]
    assert np.abs(difference).max() < 0.05
    assert np.abs(sampled.error[1000:]).max() < 1e-4
