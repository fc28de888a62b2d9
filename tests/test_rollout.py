"""Episodes of a policy: the numbers of the manual loop, alone or in a batch, compiled or not, and their limit for dt -> 0."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordEpisodeStatistics, TransformObservation

import baselines
from baselines import Trajectory, rollout_kernel
from baselines.lyapunov import Array

CHAIN = "mfc_gym/PerturbedChain-v0"
PAPER: dict[str, Any] = {
    "gain": "paper", "switching": "sign", "margin": 1.0, "model_poles": (-1,) * 3, "poles": (-4,) * 3,
    "initial_model_state": (0.5, 0.0, 0.0),
}  # fmt: skip
SIGNALS = ("time", "state", "output_derivatives", "reference", "control", "reward", "terminated", "output")


def assert_equal(one: Trajectory, other: Trajectory) -> None:
    for signal in SIGNALS:
        np.testing.assert_array_equal(getattr(one, signal), getattr(other, signal), err_msg=signal)


class Hold:
    """The same action in every step; any policy with `predict` will do."""

    def __init__(self, action: float) -> None:
        self.action = action

    def predict(
        self, observation: Array, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        assert deterministic
        return np.full((*observation.shape[:-1], 1), self.action, dtype=np.float32), state


# -- convergence to the exact solution --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "steps", "options"),
    [
        ("PerturbedChain", (2.5e-3, 1.5625e-4), {"design": "paper"}),
        ("PerturbedChain", (2.5e-3, 1.5625e-4), {"design": "surface"}),
        ("Rossler", (3.125e-4, 1.953125e-5), {"design": "surface", "gain": "theorem", "initial_model_state": "process"}),
    ],
)  # fmt: skip
def test_plain_sign_is_of_first_order(system: str, steps: tuple[float, float], options: dict[str, Any]) -> None:
    """max abs(y - y_exact) = O(dt): slope 1 over a factor 16 in dt.

    The phase of the chattering changes the constant from one dt to the next: by less than 1.3, the slope is off by
    log(1.3) / log(16) = 0.1. (Roessler's oscillator: beta = -1, a nonlinear drift, sliding from the start.)
    """
    errors, exact = [], None
    for dt in steps:
        env = gym.make(f"mfc_gym/{system}-v0", dt=dt, horizon=5.0, substeps=1)
        controller = baselines.make("mfc", env, **(PAPER | options))
        exact = exact or baselines.filippov(env, controller)
        trajectory = baselines.rollout(env, controller)
        errors.append(np.abs(trajectory.output_derivatives - exact.output_derivatives(trajectory.time))[:, 0].max())
    assert abs(np.log(errors[0] / errors[1]) / np.log(steps[0] / steps[1]) - 1) < 0.1
    assert errors[1] < 3 * steps[1]  # the constant: rates of y of order 1


# -- the same numbers, whichever way --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mfc", "mfc-conventional", "matched-only"])
def test_rollout_is_the_manual_loop(name: str) -> None:
    env = gym.make(CHAIN, horizon=0.5)
    controller = baselines.make(name, env)
    observation, _ = env.reset(seed=1)
    observations, controls, rewards, state, truncated = [observation], [], [], None, False
    while not truncated:
        action, state = controller.predict(observation, state)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert not terminated
        observations.append(observation)
        controls.append(50.0 * action[0])
        rewards.append(reward)
    history = np.array(observations)
    for compiled in (True, False):
        trajectory = baselines.rollout(env, controller, seed=1, compiled=compiled)
        np.testing.assert_array_equal(trajectory.state, history[:, :3])
        np.testing.assert_array_equal(trajectory.output_derivatives, history[:, 3:6])
        np.testing.assert_array_equal(trajectory.reference, history[:, 6:])
        np.testing.assert_array_equal(trajectory.control, controls)
        np.testing.assert_array_equal(trajectory.reward, rewards)
        assert trajectory.terminated is False


def test_lengths_and_clock() -> None:
    env = gym.make(CHAIN, horizon=0.3, dt=0.02)
    trajectory = baselines.rollout(env, Hold(0.1))
    assert (trajectory.state.shape, trajectory.reference.shape) == ((16, 3), (16, 4))
    assert trajectory.control.shape == trajectory.reward.shape == (15,)
    np.testing.assert_array_equal(trajectory.time, 0.02 * np.arange(16))
    np.testing.assert_array_equal(trajectory.control, 50.0 * float(np.float32(0.1)))


def test_actions_beyond_the_limits_are_recorded_as_they_act() -> None:
    env = gym.make(CHAIN, horizon=0.05)
    np.testing.assert_array_equal(baselines.rollout(env.unwrapped, Hold(-3.0)).control, -50.0)


def test_end_of_the_region_ends_the_episode() -> None:
    """x_3' = 50 + norm(x)^2 lies between 50 + x_3^2 and 51.1 + x_3^2, so that x_3 is sqrt(50) after 0.1088 to 0.1111 s."""
    env = gym.make(CHAIN, horizon=1.0)
    trajectory = baselines.rollout(env, Hold(1.0))
    assert trajectory.terminated is True
    assert trajectory.steps == 11
    assert trajectory.state[-1, 2] > np.sqrt(50) > trajectory.state[-2, 2]


def test_seeds_and_options() -> None:
    env = gym.make(CHAIN, scenario="random", horizon=0.1)
    controller = baselines.make("mfc", env)
    first, again, other = (baselines.rollout(env, controller, seed=seed) for seed in (5, 5, 6))
    assert_equal(first, again)
    assert not np.array_equal(first.state, other.state)
    following = [baselines.rollout(env, controller), baselines.rollout(env, controller)]  # the stream goes on
    assert not np.array_equal(following[0].state, following[1].state)
    options = {"initial_state": [0.1, 0.2, 0.3], "theta": [0.0, 0.0]}
    chosen = baselines.rollout(env, controller, seed=5, options=options)
    np.testing.assert_array_equal(chosen.state[0], options["initial_state"])
    np.testing.assert_array_equal(chosen.output_derivatives[0], options["initial_state"])


def test_wrappers_stay_in_the_loop() -> None:
    """One that only listens changes no number; one that alters what the policy sees is not bypassed."""
    env = gym.make(CHAIN, horizon=0.5)
    controller = baselines.make("mfc", env)
    plain = baselines.rollout(env, controller)
    listening = RecordEpisodeStatistics(gym.make(CHAIN, horizon=0.5))
    assert_equal(plain, baselines.rollout(listening, controller))
    assert listening.return_queue[0] == pytest.approx(
        plain.reward.sum(), rel=1e-12
    )  # sums of 50 numbers in another order
    shift = np.zeros(10)
    shift[3] = 0.01
    altered = baselines.rollout(TransformObservation(env, lambda o: o + shift, env.observation_space), controller)
    assert not np.array_equal(plain.control, altered.control)
    np.testing.assert_allclose(altered.output_derivatives[0], plain.output_derivatives[0] + shift[3:6])


def test_controller_of_another_plant() -> None:
    """Too long an observation is an error in the compiled loop too, not memory read beyond its end."""
    controller = baselines.make("mfc", gym.make(CHAIN, order=2, substeps=1))
    with pytest.raises(ValueError, match="`observation` must be finite, of shape"):
        baselines.rollout(gym.make(CHAIN, horizon=0.1), controller)


def test_controller_with_another_input_limit() -> None:
    """Its actions are fractions of its own limit: they would be another input."""
    controller = baselines.make("mfc", gym.make(CHAIN, input_limit=20.0, substeps=1))
    env = gym.make(CHAIN, horizon=0.2)
    for run in (baselines.rollout, baselines.filippov):
        with pytest.raises(ValueError, match="`controller` must be made for this environment's input_limit 50"):
            run(env, controller)


def test_environments_without_a_nominal_model() -> None:
    controller = baselines.make("mfc", gym.make(CHAIN, substeps=1))
    for env in (gym.make("CartPole-v1"), gym.make_vec(CHAIN, 2, vectorization_mode="sync")):
        with pytest.raises(ValueError, match="`env` must be an environment of mfc_gym"):
            baselines.rollout(env, controller)


# -- batches ----------------------------------------------------------------------------------------------------------------

MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]


MEASURED: dict[str, Any] = {"derivatives": "ired", "sensors": {"noise": 0.03, "delay": 1, "dropout": 0.2}}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("measured", [{}, MEASURED])
def test_batch_is_the_scalar_episodes(mode: AutoresetMode, measured: dict[str, Any]) -> None:
    """Environment i of a batch seeded s has the episode of a scalar environment seeded s + i, bit by bit."""
    envs = gym.make_vec(
        CHAIN, num_envs=3, vectorization_mode="vector_entry_point",
        autoreset_mode=mode, scenario="random", horizon=0.3, **measured,
    )  # fmt: skip
    env = gym.make(CHAIN, scenario="random", horizon=0.3, **measured)
    controller = baselines.make("mfc", env)
    scalar = [baselines.rollout(env, controller, seed=7 + i) for i in range(3)]
    for compiled in (True, False):
        batch = baselines.rollout(envs, baselines.make("mfc", envs), seed=7, compiled=compiled)
        assert batch.control.shape == (30, 3)
        for one, other in zip(batch.episodes(), scalar, strict=True):
            assert_equal(one, other)


@pytest.mark.parametrize("mode", MODES)
def test_batch_with_episodes_of_different_length(mode: AutoresetMode) -> None:
    """What follows an episode's end is NaN; its last sample is its own, whatever begins next.

    x_3' = 25 + x_3^2 or a little more: sqrt(50) is reached after 0.19, 0.034 and 0.016 s.
    """
    starts = [[1.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, 0.0, 6.0]]
    envs = gym.make_vec(CHAIN, num_envs=3, vectorization_mode="vector_entry_point", autoreset_mode=mode, horizon=0.1)
    batch = baselines.rollout(envs, Hold(0.5), options={"initial_state": starts})
    env = gym.make(CHAIN, horizon=0.1)
    scalar = [baselines.rollout(env, Hold(0.5), options={"initial_state": start}) for start in starts]
    np.testing.assert_array_equal(batch.terminated, [False, True, True])
    np.testing.assert_array_equal(batch.steps, [10, 4, 2])
    for i, (one, other) in enumerate(zip(batch.episodes(), scalar, strict=True)):
        assert_equal(one, other)
        assert np.isnan(batch.control[batch.steps[i] :, i]).all()
        assert np.isnan(batch.state[batch.steps[i] + 1 :, i]).all()


def test_more_episodes_than_run_side_by_side() -> None:
    """The compiled loop takes them in blocks; some leave the region, each at its own time."""
    count = rollout_kernel.BLOCK + 2
    options = {"scenario": "random", "dt": 0.05, "horizon": 1.0, "input_limit": 8.0}
    envs = gym.make_vec("mfc_gym/PerturbedChain-v0", count, vectorization_mode="vector_entry_point", **options)
    controller = baselines.make("mfc", envs)
    starts = {"initial_state": np.random.default_rng(0).uniform(-2.0, 2.0, (count, 3))}
    one, other = (baselines.rollout(envs, controller, 0, starts, compiled=compiled) for compiled in (True, False))
    assert 0 < one.terminated.sum() < count
    assert np.array_equal(one.terminated, other.terminated)
    assert_equal(one, other)
