"""What a controller may know, and that it is no more than that."""

import pickle
from collections.abc import Callable
from dataclasses import fields
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from mfc_gym import plant
from mfc_gym.env import TrackingEnv
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)


def model(name: str = "PerturbedChain", **options: object) -> NominalModel:
    return NominalModel(plant.load(name, **options).nominal, dt=0.01, input_limit=50.0)


def test_the_chain_by_hand() -> None:
    """tau = x, alpha = 0, beta = 1, delta_1 = (1 + rho) abs(x)^2, delta_3 = rho; dyadic numbers are not rounded."""
    nominal, x = model(), np.array([1.0, -2.0, 0.5])
    np.testing.assert_array_equal(nominal.tau(x), x)
    np.testing.assert_array_equal(nominal.f(x), [-2.0, 0.5, 0.0])
    np.testing.assert_array_equal(nominal.g(x), [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(nominal.tau_jacobian(x), np.eye(3))
    assert (nominal.alpha(x), nominal.beta(x)) == (0.0, 1.0)
    assert (nominal.delta_1(x), nominal.delta_3(x)) == (1.25 * 5.25, 0.25)
    assert (nominal.name, nominal.order, nominal.dt, nominal.input_limit) == ("perturbed chain", 3, 0.01, 50.0)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_batches(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    """Functions of x take (..., n); one point gives bit for bit what it gives in a batch, also from a strided array."""
    nominal = model("FlexibleJoint")
    x = rng.uniform(-1, 1, (*shape, 4))
    for function, tail in (("tau", (4,)), ("f", (4,)), ("g", (4,)), ("alpha", ()), ("beta", ()), ("delta_1", ())):
        whole = getattr(nominal, function)(x)
        assert whole.shape == (*shape, *tail)
        single = [getattr(nominal, function)(point) for point in x.reshape(-1, 4)]
        np.testing.assert_array_equal(whole.reshape(-1, *tail), np.array(single).reshape(-1, *tail))
        np.testing.assert_array_equal(
            getattr(nominal, function)(np.asfortranarray(np.repeat(x, 2, axis=-1))[..., ::2]), whole
        )


def test_bounds_of_the_chain_hold(rng: np.random.Generator) -> None:
    """abs(Delta_1) <= delta_1, abs(Delta_3) <= delta_3, abs(phi_m) <= delta_m, and divided by 1 + Delta_3 the sharp
    ones, wherever abs(p - 1) <= rho; two of them are attained, hence the rounding."""
    built = plant.load("PerturbedChain", order=4)
    seen = 0
    while seen < 200:
        theta = rng.uniform(*built.theta_set)
        x = rng.uniform(*built.region(50.0))
        Delta_1, Delta_3, phi_m = built.kernel.uncertainty_at(x, theta)
        if abs(Delta_3) > 0.25:
            continue
        seen += 1
        delta_1, delta_3, delta_m, sharp_1, sharp_3 = built.nominal.terms_at(x[None])[0, 6:11]
        room = 1 + 8 * EPS
        assert abs(Delta_1) <= delta_1 * room
        assert abs(Delta_3) <= delta_3 * room
        assert abs(phi_m) <= delta_m * room
        assert abs(Delta_1) / (1 + Delta_3) <= sharp_1 * room
        assert abs(Delta_3) / (1 + Delta_3) <= sharp_3 * room


@pytest.mark.parametrize("name", ["PerturbedChain", "FlexibleJoint", "Chua", "CSTR", "MagneticLevitation"])
def test_tau_inverse(name: str, rng: np.random.Generator) -> None:
    """Back at x up to what the stopping rule leaves, 1e-13 (1 + abs(xi)) through the inverse Jacobian."""
    built = plant.load(name)
    nominal = NominalModel(built.nominal, 0.01, 1.0)
    low, high = built.region(built.task.input_limit)
    for _ in range(20):
        x = rng.uniform(low, high)
        xi = nominal.tau(x)
        inverse = np.linalg.norm(np.linalg.inv(nominal.tau_jacobian(x)), np.inf)
        found = nominal.tau_inverse(xi, guess=x + 0.02 * (high - low) * rng.uniform(-1, 1, x.size))
        assert np.abs(found - x).max() <= 2 * inverse * 1e-13 * (1 + np.abs(xi).max())


def test_tau_inverse_from_the_origin(rng: np.random.Generator) -> None:
    x = rng.uniform(-1, 1, 4)
    found = model("FlexibleJoint").tau_inverse(model("FlexibleJoint").tau(x))
    np.testing.assert_allclose(
        found, x, rtol=0, atol=1e-12
    )  # 1e-13 (1 + 40) / 19.5, the entries of the inverse Jacobian


@pytest.mark.parametrize(
    ("name", "xi", "guess"),
    [
        ("MagneticLevitation", (0.05, 0.0, 0.0), None),  # no current at the origin: a singular Jacobian
        ("PerturbedChain", (0.0, np.nan, 0.0), None),
        ("MagneticLevitation", (0.05, 0.0, 1e3), (0.05, 0.0, 6.0)),  # a magnet only pulls
    ],
)
def test_tau_inverse_fails_loudly(name: str, xi: tuple[float, ...], guess: tuple[float, ...] | None) -> None:
    with pytest.raises(ValueError, match=r"`xi` must be in the range of tau, got .*Newton's method did not converge"):
        model(name).tau_inverse(np.array(xi), None if guess is None else np.array(guess))


# -- the information barrier ------------------------------------------------------------------------------------------


def test_the_truth_is_out_of_reach(make: Callable[..., TrackingEnv]) -> None:
    """Neither the model's fields nor its compiled module lead to theta, Delta or the true plant."""
    env = make(scenario="random")
    env.reset(seed=0)
    nominal = env.nominal
    for field in fields(nominal):
        assert isinstance(getattr(nominal, field.name), (ModuleType, float, str))
    known = vars(nominal.kernel)
    generated = {name for name, value in known.items() if getattr(value, "__module__", None) == nominal.kernel.__name__}
    reachable = {name for name in known if not name.startswith("__")} - generated - {"math", "np", "njit", "SOURCE"}
    assert reachable == {"NAME", "STATE", "ORDER", "EQUATIONS"}
    assert generated == {
        *("coordinates", "lie_terms", "bounds", "nominal_drift", "input_field", "jacobian", "jacobian_at", "terms_at"),
        *("spread", "spread_at"),
    }
    assert set(nominal.kernel.EQUATIONS) == {"f", "g", "h"}


def test_the_model_is_blind_to_theta(make: Callable[..., TrackingEnv]) -> None:
    """Environments that differ in the truth alone have the same nominal model."""
    models = [make(theta=theta).nominal for theta in ((0.5, -0.5), (0.0, 0.0), (0.1, 0.1))]
    assert models[0] == models[1] == models[2]
    assert make(rho=0.5).nominal != models[0]


def test_pickles(make: Callable[..., TrackingEnv]) -> None:
    nominal = make().nominal
    assert pickle.loads(pickle.dumps(nominal)) == nominal
