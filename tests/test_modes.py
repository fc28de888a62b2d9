"""Residual agents and clones: begin as the controller, act in evaluation as in training, know no more than it."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from stable_baselines3.common.logger import Logger  # noqa: E402

import baselines  # noqa: E402
from baselines import evaluation, learner  # noqa: E402
from baselines.agent_files import load_agent, save_agent  # noqa: E402
from baselines.agents import make_vec_env  # noqa: E402
from baselines.hyperparameters import HYPERPARAMETERS  # noqa: E402
from baselines.imitation import Cloning, clone, record  # noqa: E402
from baselines.modes import MODES  # noqa: E402
from baselines.policy_network import Agent  # noqa: E402
from baselines.residual import Base  # noqa: E402
from baselines.training import Plan, Training, train  # noqa: E402
from baselines.training_env import TrainingEnv  # noqa: E402
from baselines.validation import Evaluation  # noqa: E402
from scripts import train_rl  # noqa: E402

ROOT = Path(__file__).parents[1]
ENV = "mfc_gym/PerturbedChain-v0"
OPTIONS: dict[str, Any] = {"scenario": "random", "dt": 0.05, "horizon": 2.0}
OBSERVE = ("integral", "last-action", "past:2")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def training(algorithm: str = "ppo", **changes: Any) -> Training:
    given: dict[str, Any] = {"seed": 0, "timesteps": 64, "episodes": 2, "mode": "residual", **changes}
    return Training(Plan(algorithm, ENV, OPTIONS, **given))


def disturbed(agent: Agent) -> Agent:
    """The same with other weights in the last layer: an agent that has learnt something."""
    *layers, (weight, bias) = agent.layers
    rng = np.random.default_rng(0)
    return replace(agent, layers=(*layers, (weight + rng.normal(size=weight.shape), bias + 0.3)))


def outputs(agent: Agent, features: Any) -> Any:
    """What the agent's network makes of features that it is given, limited as it limits them."""
    z = features.astype(float)
    for weight, bias in agent.layers[:-1]:
        z = np.tanh(z @ weight.T + bias)
    weight, bias = agent.layers[-1]
    return np.clip(z @ weight.T + bias, -1.0, 1.0)


@pytest.mark.parametrize("algorithm", list(HYPERPARAMETERS))
def test_an_untrained_correction_is_the_controller(algorithm: str) -> None:
    """To the last bit, alone and in a batch, whatever is observed."""
    agent = training(algorithm, observe=OBSERVE).agent()
    for env, seed in (
        (gym.make(ENV, **OPTIONS), 5),
        (gym.make_vec(ENV, 7, vectorization_mode="vector_entry_point", **OPTIONS), 8),
    ):
        expected = baselines.rollout(env, baselines.make("mfc", env), seed=seed, compiled=False)
        found = baselines.rollout(env, agent.made_for(env), seed=seed)
        assert np.array_equal(found.control, expected.control, equal_nan=True)


@pytest.mark.parametrize(
    ("mode", "observe"), [("residual", ()), ("residual", OBSERVE), ("direct", (*OBSERVE, "output-only"))]
)
def test_an_agent_does_in_evaluation_what_it_did_in_training(mode: str, observe: tuple[str, ...]) -> None:
    """Through episodes that end and begin anew in the same step: features in training, `predict` with state and episode_start."""
    made = training(mode=mode, observe=observe)
    agent = disturbed(made.agent())
    native = make_vec_env(ENV, 6, seed=3, **OPTIONS)
    env = TrainingEnv(native, made.features, 0.98, native.get_attr("simulation")[0], made.interface)
    other = make_vec_env(ENV, 6, seed=3, **OPTIONS)
    features, observations = env.reset(), other.reset()
    state, start = None, np.ones(6, dtype=bool)
    ends = 0
    for _ in range(90):
        action, state = agent.predict(observations, state, start)
        observations, _, start, _ = other.step(action)
        features, _, dones, others = env.step(outputs(agent, features))
        assert np.array_equal(dones, start)
        # features in float32, times the input limit, times what an unstable plant makes of it in 2 s
        assert np.abs(env.unwrapped.envs.rows - other.envs.rows).max() < 1e-3  # type: ignore[attr-defined]
        for i in np.flatnonzero(dones):
            assert others[i]["terminal_observation"].shape == features[i].shape
        ends += int(dones.sum())
    assert ends >= 12


def test_a_terminal_observation_is_seen_with_its_own_past() -> None:
    """Where an episode ends the features are those of its last sample, not those of a first one."""
    made = training(observe=("integral", "past:1"))
    native = make_vec_env(ENV, 3, seed=3, **OPTIONS)
    env = TrainingEnv(native, made.features, 0.98, native.get_attr("simulation")[0], made.interface)
    env.reset()
    integral = 13 + np.array([0])  # after [x, xi_n, y_d ..., e]
    for _ in range(40):
        features, _, dones, infos = env.step(np.zeros((3, 1), dtype=np.float32))
    assert dones.all()
    first = (0.0 * made.features.offset + made.features.offset)[integral]
    for i in range(3):
        assert np.allclose(features[i, integral], first, rtol=1e-6, atol=0)
        assert not np.allclose(infos[i]["terminal_observation"][integral], first, rtol=1e-3, atol=0)


def test_what_is_saved_is_rebuilt_for_another_environment(tmp_path: Path) -> None:
    """Base by name and options, fade, memory; the controller of the environment it is evaluated in, at its sampling time."""
    base = Base("mfc", {"margin": 1.3}, bound=0.2)
    agent = disturbed(training(observe=OBSERVE, base=base).agent())
    save_agent(agent, tmp_path)
    loaded = load_agent(tmp_path, "ppo")
    with pytest.raises(ValueError, match="`made_for"):
        loaded.predict(np.zeros(10))
    env = gym.make(ENV, **{**OPTIONS, "dt": 0.02})
    found = evaluation.entry(f"ppo:{tmp_path}", env)
    made = found.policy.interface
    assert made.controller.margin == 1.3
    assert (made.controller.nominal.dt, made.observer.dt) == (0.02, 0.02)
    assert made.base.fade == agent.interface.base.fade  # type: ignore[union-attr]
    assert found.reads == ("state", "output derivatives", "nominal model", "bounds")
    trajectory, expected = (baselines.rollout(env, one, seed=1) for one in (found.policy, agent.made_for(env)))
    assert np.abs(trajectory.control - expected.control).max() < 1e-4  # weights in float32


def test_the_correction_is_bounded_and_fades(rng: np.random.Generator) -> None:
    observations = rng.normal(size=(200, 10))
    base = Base(bound=0.2, fade=(0.5, 1.0, 2.0))
    e = observations[:, 3:6] - observations[:, 6:9]
    size = np.abs(e / np.array(base.fade)).max(axis=1)
    assert np.allclose(base.reach(observations), 0.2 * np.minimum(1.0, size), rtol=1e-14, atol=0)
    observations[:, 3:6] = observations[:, 6:9]
    assert (base.reach(observations) == 0.0).all()
    agent = disturbed(training(base=Base(bound=0.05), fade=0.0).agent())
    env = gym.make_vec(ENV, 50, vectorization_mode="vector_entry_point", **OPTIONS)
    seen, _ = env.reset(seed=0)
    action, _ = agent.made_for(env).predict(seen)
    alone, _ = baselines.make("mfc", env).predict(seen)
    assert 0.0 < np.abs(action - alone).max() <= 0.05 + 1e-15


def test_a_residual_agent_knows_no_more_than_its_base_and_the_observation() -> None:
    """Two plants that behave differently behind the same observations: the same actions, to the last bit."""
    agent = disturbed(training(observe=OBSERVE).agent())
    envs = [gym.make(ENV, theta=theta, dt=0.05) for theta in ((0.5, -0.5), (-0.2, 0.1))]
    agents = [agent.made_for(env) for env in envs]
    t = 0.05 * np.arange(30)[:, None]
    seen = np.hstack([0.5 * np.cos(t + np.arange(6)), np.sin(t + np.arange(4) * np.pi / 2)])
    states: list[Any] = [None, None]
    for row in seen:
        actions = []
        for i, one in enumerate(agents):
            envs[i].reset(seed=i)
            action, states[i] = one.predict(row, states[i])
            actions.append(action)
        assert np.array_equal(*actions)


def test_a_clone_tracks() -> None:
    """On episodes it has not seen, without one step of reinforcement learning; and it is always the same clone."""
    plan = Plan("ppo", ENV, {**OPTIONS, "dt": 0.02, "horizon": 6.0}, seed=0, timesteps=0, episodes=2, mode="imitation")
    given, made, again = Cloning(episodes=64, updates=50), Training(plan), Training(plan)
    signals, actions = record(plan.env, plan.options, plan.base, made.interface, 77, given)
    for one in (made, again):
        clone(one.model, one.features(signals), actions, 0, given)
    for (w, b), (v, c) in zip(made.agent().layers, again.agent().layers, strict=True):
        assert np.array_equal(w, v)
        assert np.array_equal(b, c)
    assert clone(made.model, made.features(signals), actions, 0, replace(given, updates=1200)) < 0.2
    held_out = Evaluation(ENV, plan.options, episodes=32, seed=0)
    found = held_out(made.agent())
    assert found["escaped"] == 0
    assert found["return"] > 1.5 * held_out.reference["return"]


def test_the_critic_learns_before_a_clone_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    given = HYPERPARAMETERS["ppo"]
    options = {**given.options, "n_steps": 32, "batch_size": 256, "n_epochs": 2}
    monkeypatch.setitem(HYPERPARAMETERS, "ppo", replace(given, num_envs=16, segment=512, options=options))
    monkeypatch.setitem(MODES, "imitation", replace(MODES["imitation"], critic_first=512))
    made = training(mode="imitation", timesteps=1024)
    made.model.set_logger(Logger(None, []))
    layers = [[weight.copy() for weight, _ in made.agent().layers]]
    critic = made.model.policy.value_net.weight.detach().clone()
    for _ in range(2):
        made.segment(lambda timesteps: None)
        layers.append([weight.copy() for weight, _ in made.agent().layers])
    same = [all(map(np.array_equal, one, other)) for one, other in pairwise(layers)]
    assert same == [True, False]
    assert not torch.equal(critic, made.model.policy.value_net.weight)


def test_modes_resume_and_say_what_does_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = HYPERPARAMETERS["ppo"]
    options = {**given.options, "n_steps": 32, "batch_size": 256, "n_epochs": 2}
    monkeypatch.setitem(HYPERPARAMETERS, "ppo", replace(given, num_envs=16, segment=512, options=options))
    plan = Plan("ppo", ENV, OPTIONS, 1, 1024, 2, mode="residual", observe=OBSERVE)
    whole = train(plan, tmp_path / "whole")
    half = Training(plan)
    half.model.set_logger(whole.model.logger.__class__(None, []))
    half.segment(lambda timesteps: None)
    half.save(tmp_path / "half")
    resumed = train(plan, tmp_path / "half", resume=True)
    for (w, b), (v, c) in zip(whole.agent().layers, resumed.agent().layers, strict=True):
        assert np.array_equal(w, v)
        assert np.array_equal(b, c)
    with pytest.raises(ValueError, match=r"other \['fade'\]"):
        train(replace(plan, fade=0.5), tmp_path / "half", resume=True)


@pytest.mark.parametrize("measured", [{}, {"derivatives": "ired", "sensors": {"noise": 1e-4}}])
def test_the_shipped_correction_is_no_worse_and_better_under_noise(measured: dict[str, Any]) -> None:
    """On 200 of the episodes that the document speaks of: median and worst tail, return, escapes."""
    agent = load_agent(ROOT / "agents" / "residual-perturbed-chain", "ppo")
    options = {"scenario": "random", "dt": 0.02, "horizon": 10.0, **measured}
    held_out = Evaluation(ENV, options, episodes=200, seed=1000)
    found, reference = held_out(agent.made_for(held_out.envs)), held_out.reference
    assert found["escaped"] <= reference["escaped"] == 0
    assert found["tail_rms"] < (0.85 if measured else 1.0) * reference["tail_rms"]
    assert found["tail_rms_worst"] < reference["tail_rms_worst"]
    assert found["return"] > 0.95 * reference["return"]


def test_silence_is_of_the_mean_only() -> None:
    """A silent actor still explores."""
    made = training()
    learner.silence(made.model)
    observations = torch.zeros(64, made.features.offset.size)
    actions = made.model.policy(observations)[0]
    assert actions.std() > 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "expert"}, "`mode` must be one of direct, residual, imitation"),
        ({"mode": "residual", "bound": 0.0}, "`bound` must lie in"),
        ({"mode": "residual", "bound": float("nan")}, "`bound` must lie in"),
        ({"mode": "residual", "fade": -1.0}, "`fade` must be finite"),
        ({"mode": "residual", "base": "nobody"}, "`name` must be one of"),
        ({"mode": "residual", "base": "mfc:colour=3"}, "does not take these options"),
        ({"mode": "imitation", "base": "nobody", "timesteps": 0}, "`name` must be one of"),
        ({"mode": "residual", "timesteps": 0}, "`timesteps` must be at least 1"),
        ({"observe": ("theta",)}, "`observe` must be of"),
        ({"noise": 1e-4}, "derivatives"),
    ],
)
def test_arguments_that_cannot_work_are_refused(arguments: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        train_rl.main(train_rl.Arguments("ppo", out=tmp_path, **arguments))
    assert not list(tmp_path.iterdir())
