"""Sensors: the random numbers, each effect alone against its closed form, and the loop with a differentiator."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from scipy import stats

import baselines
import mfc_gym  # noqa: F401
from mfc_gym import observation as layout
from mfc_gym.sensors import Sensors, gaussian, quantised, random, uniform

ID = "mfc_gym/PerturbedChain-v0"
DIFFERENTIATED = {"derivatives": "ired", "dt": 0.01, "horizon": 2.0}


def draws(function: object, count: int, key: float = 12345.0, channel: int = 1) -> np.ndarray:
    return np.array([function(key, float(k), channel) for k in range(count)])  # type: ignore[operator]


def measured(**options: object) -> tuple[np.ndarray, np.ndarray]:
    """(observations, true y) of an episode with zero input."""
    env = gym.make(ID, **{**DIFFERENTIATED, **options})
    observation, _ = env.reset(seed=3, options={"initial_state": [0.1, 0.0, 0.0]})
    rows, outputs = [observation], [env.unwrapped.output]  # type: ignore[attr-defined]
    for _ in range(150):
        rows.append(env.step(np.zeros(1))[0])
        outputs.append(env.unwrapped.output)  # type: ignore[attr-defined]
    return np.array(rows), np.array(outputs)


def test_random_numbers_have_their_distribution() -> None:
    """Kolmogorov-Smirnov with fixed keys; a p-value below 1e-3 would be an accident of one key in a thousand."""
    assert stats.kstest(draws(random, 5000), "uniform").pvalue > 1e-3
    assert stats.kstest(draws(uniform, 5000), "uniform", (-1, 2)).pvalue > 1e-3
    assert stats.kstest(draws(gaussian, 5000), "norm").pvalue > 1e-3


def test_samples_channels_and_keys_are_uncorrelated() -> None:
    """Correlation of 5000 pairs: standard deviation 1 / sqrt(5000) = 0.014, five of them allowed."""
    base = draws(uniform, 5001)
    for other in (base[1:], draws(uniform, 5000, key=12346.0), draws(uniform, 5000, channel=2)):
        assert abs(np.corrcoef(base[:5000], other)[0, 1]) < 5 / np.sqrt(5000)


def test_quantised_is_the_nearest_multiple() -> None:
    assert [quantised(v, 0.5) for v in (0.2, 0.3, -0.3, 1.0)] == [0.0, 0.5, -0.5, 1.0]
    assert quantised(0.123, 0.0) == 0.123


def test_ideal_sensors_and_ired_measure_y_exactly() -> None:
    """IRED reproduces what it is given once it slides; the state is exact."""
    rows, outputs = measured()
    assert np.abs(layout.output_derivatives(rows)[20:, 0] - outputs[20:]).max() < 1e-12


def test_noise_on_y_is_bounded_by_its_amplitude() -> None:
    """The dirty derivative passes y through: its first entry is the measurement itself."""
    rows, outputs = measured(derivatives="dirty", sensors={"noise": 1e-3})
    noise = layout.output_derivatives(rows)[1:, 0] - outputs[1:]
    assert 0.8e-3 < np.abs(noise).max() <= 1e-3


def test_noise_on_the_state_leaves_the_plant_alone() -> None:
    rows, outputs = measured(sensors={"state_noise": 1e-3})
    clean, clean_outputs = measured()
    assert np.array_equal(outputs, clean_outputs)
    noise = layout.state(rows) - layout.state(clean)
    assert 0.8e-3 < np.abs(noise).max() <= 1e-3


def test_quantisation_of_y() -> None:
    rows, outputs = measured(derivatives="dirty", sensors={"quantisation": 0.01})
    y = layout.output_derivatives(rows)[1:, 0]
    assert np.abs(y - 0.01 * np.round(y / 0.01)).max() < 1e-12
    assert np.abs(y - outputs[1:]).max() <= 0.005 + 1e-12


def test_delay_is_a_shift_by_whole_samples() -> None:
    """After the delay: what was measured `delay` samples ago; before: the first sample."""
    rows, _ = measured(derivatives="dirty", sensors={"delay": 4})
    clean, _ = measured(derivatives="dirty")
    assert np.array_equal(layout.state(rows)[4:], layout.state(clean)[:-4])
    assert np.array_equal(layout.output_derivatives(rows)[5:, 0], layout.output_derivatives(clean)[1:-4, 0])
    assert (layout.state(rows)[:4] == layout.state(clean)[0]).all()


def test_dropouts_hold_the_last_sample() -> None:
    """Fraction of held samples: binomial, 150 trials of 0.3, five standard deviations of 0.037."""
    rows, outputs = measured(derivatives="dirty", sensors={"dropout": 0.3})
    y = layout.output_derivatives(rows)[:, 0]
    held = y[2:] == y[1:-1]
    assert abs(held.mean() - 0.3) < 5 * 0.037
    assert np.array_equal(y[2:][~held], outputs[2:][~held])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_scalar_and_vector_agree_bit_for_bit(mode: AutoresetMode) -> None:
    sensors = {
        "noise": 1e-3,
        "state_noise": 1e-4,
        "delay": 2,
        "dropout": 0.1,
        "quantisation": 1e-4,
        "distribution": "gaussian",
    }
    options = {**DIFFERENTIATED, "sensors": sensors, "scenario": "random"}
    envs = gym.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options)
    batch = baselines.rollout(envs, baselines.make("mfc", envs), seed=5)
    for i in range(3):
        env = gym.make(ID, **options)
        alone = baselines.rollout(env, baselines.make("mfc", env), seed=5 + i, compiled=False)
        steps = alone.steps
        for name in ("state", "output_derivatives", "control", "reward"):
            assert np.array_equal(getattr(alone, name)[:steps], getattr(batch, name)[:steps, i])


@pytest.mark.parametrize("derivatives", ["ired", "hdd", "ired-linear", "high-gain"])
@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_the_loop_survives_a_wrong_initial_estimate(derivatives: str, dt: float) -> None:
    """However wrong: the bounds say where xi_n may be, given the state. The tail is as from the right guess, up to 10 %."""
    env = gym.make(ID, derivatives=derivatives, dt=dt)
    controller = baselines.make("mfc", env)
    right = baselines.rollout(env, controller)
    for estimate in ([0.0, 0.0, 0.0], [1.0, 3.0, 5.0], [5.0, -5.0, 5.0]):
        wrong = baselines.rollout(env, controller, options={"initial_estimate": estimate})
        assert not wrong.terminated
        tails = [np.abs(t.error[t.error.size // 2 :]).max() for t in (wrong, right)]
        assert tails[0] == pytest.approx(tails[1], rel=0.1)


def test_large_noise_stays_inside_the_observation_space() -> None:
    """Noise of the size of the signal: the sensors read the ends of their ranges, and nothing is NaN."""
    env = gym.make(ID, derivatives="ired", sensors={"noise": 3.0, "state_noise": 30.0})
    observation, _ = env.reset(seed=0)
    for _ in range(100):
        assert (env.observation_space.low < observation).all()
        assert (observation < env.observation_space.high).all()
        observation, *_ = env.step(np.zeros(1))


@pytest.mark.parametrize("derivatives", ["ired", "hdd", "ired-linear", "high-gain"])
@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_the_reference_policy_with_noise_neither_diverges_nor_chatters(derivatives: str, dt: float) -> None:
    """Uniform noise of 1e-4 on y: no escape, tail within 5 % of the reference, and half the variation, at most, that the
    paper's law with the explicit sign has without any noise."""
    env = gym.make(ID, derivatives=derivatives, sensors={"noise": 1e-4}, dt=dt)
    own = baselines.rollout(env, baselines.make("mfc", env))
    half = own.control.size // 2
    assert not own.terminated
    assert np.abs(own.error[half:]).max() < 0.05
    ideal = gym.make(ID, dt=dt)
    sign = baselines.rollout(ideal, baselines.make("mfc", ideal, design="paper", gain="paper", switching="sign"))
    variation = [np.abs(np.diff(t.control[half:])).sum() for t in (own, sign)]
    assert variation[0] < 0.5 * variation[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"derivatives": "guessed"}, "`derivatives` must be one of"),
        ({"sensors": {"noise": 1e-3}}, "must come with derivatives"),
        (
            {"derivatives": "ired", "sensors": {"noise": -1.0}},
            "`noise` of the sensors must be finite and >= 0, got -1.0",
        ),
        ({"derivatives": "ired", "sensors": {"colour": 1.0}}, "`sensors` must be a dict with keys among"),
        ({"derivatives": "ired", "sensors": {"dropout": 1.0}}, r"`dropout` of the sensors must lie in \[0, 1\)"),
        ({"derivatives": "ired", "sensors": {"delay": 1.5}}, "`delay` of the sensors must be an integer"),
        ({"derivatives": "ired", "sensors": {"distribution": "flat"}}, "`distribution` of the sensors must be one of"),
        ({"derivatives": "high-gain", "differentiator": {"bandwith": 3.0}}, "`differentiator` must have keys among"),
        (
            {"derivatives": "high-gain", "differentiator": {"bandwidth": 0.0}},
            "`bandwidth of the differentiator` must be positive",
        ),
    ],
)
def test_errors(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **options)


def test_default_sensors_are_ideal() -> None:
    assert Sensors.of(None) == Sensors() == Sensors.of({})
