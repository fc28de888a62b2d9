"""The contract of every controller, and the options of the redesign family."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import baselines
from baselines.lyapunov import Array

CHAIN = "mfc_gym/PerturbedChain-v0"
READS = {"output", "output derivatives", "state", "nominal model", "bounds", "true model"}
FAMILY = ("mfc", "mfc-conventional", "single-loop", "matched-only")
MARK = pytest.mark.parametrize("name", baselines.names())


@pytest.fixture(scope="module")
def env() -> Any:
    return gym.make(CHAIN, scenario="random", horizon=0.5)


def observations(env: Any, count: int = 6) -> Array:
    """First observations of episodes, shape (count, 10)."""
    return np.array([env.reset(seed=seed)[0] for seed in range(count)])


def along(rows: Array, time: int) -> Array:
    """Later observations: other numbers in the same range."""
    return rows + 0.01 * np.sin(np.arange(rows.size).reshape(rows.shape) + time)


# -- predict ----------------------------------------------------------------------------------------------------------------


def test_names() -> None:
    assert set(FAMILY) <= set(baselines.names())


@MARK
def test_controller_says_what_it_is(name: str, env: Any) -> None:
    controller = baselines.make(name, env)
    assert controller.name == name
    assert set(controller.reads) <= READS
    assert controller.reads
    assert controller.nominal is env.unwrapped.nominal


@MARK
def test_batch_is_row_by_row(name: str, env: Any) -> None:
    """Actions and states, over several steps, to the last bit; the shapes are those of the observations."""
    controller, rows = baselines.make(name, env), observations(env)
    batch_state, states = None, [None] * len(rows)
    for time in range(4):
        now = along(rows, time)
        batch_action, batch_state = controller.predict(now, batch_state)
        assert batch_action.shape == (len(rows), 1)
        for i, row in enumerate(now):
            action, states[i] = controller.predict(row, states[i])
            assert action.shape == (1,)
            np.testing.assert_array_equal(action, batch_action[i])
            np.testing.assert_array_equal(states[i], batch_state[i])


@MARK
def test_memory_travels_in_the_state(name: str, env: Any) -> None:
    """The same observation and state give the same answer, however often and after whatever else; nothing is changed."""
    controller, rows = baselines.make(name, env), observations(env)
    _, state = controller.predict(rows)
    kept_rows, kept_state = rows.copy(), state.copy()
    first = controller.predict(rows, state)
    controller.predict(along(rows, 5), state)
    controller.predict(rows[:2], None)
    again = controller.predict(rows, state, episode_start=np.zeros(len(rows), dtype=bool))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(rows, kept_rows)
    np.testing.assert_array_equal(state, kept_state)
    assert not np.shares_memory(first[1], state)


@MARK
def test_episode_start_begins_these_episodes_only(name: str, env: Any) -> None:
    controller, rows = baselines.make(name, env), observations(env)
    _, state = controller.predict(rows)
    _, state = controller.predict(along(rows, 1), state)
    start = np.array([True, False, True, False, False, True])
    now = along(rows, 2)
    action, later = controller.predict(now, state, episode_start=start)
    for i, begins in enumerate(start):
        expected = controller.predict(now[i], None if begins else state[i])
        np.testing.assert_array_equal(action[i], expected[0])
        np.testing.assert_array_equal(later[i], expected[1])
    single = controller.predict(now[0], state[0], episode_start=np.array([True]))
    np.testing.assert_array_equal(single[0], action[0])


@MARK
def test_void_memory_leaves_no_trace(name: str, env: Any) -> None:
    """Where an episode begins the old memory may be anything, even not a number."""
    controller, rows = baselines.make(name, env), observations(env)
    expected = controller.predict(rows)
    state = np.full_like(expected[1], np.nan)
    for one, other in zip(controller.predict(rows, state, np.ones(len(rows), dtype=bool)), expected, strict=True):
        np.testing.assert_array_equal(one, other)


@MARK
def test_actions_keep_to_the_limits(name: str, env: Any) -> None:
    """In [-1, 1] wherever the state is, and attained: a state this far off asks for more than the plant can give."""
    controller = baselines.make(name, env)
    rows = np.random.default_rng(0).uniform(-100, 100, (500, 10))
    state, largest = None, 0.0
    for time in range(3):
        action, state = controller.predict(along(rows, time), state)
        assert np.isfinite(state).all()
        assert (np.abs(action) <= 1).all()
        largest = max(largest, np.abs(action).max())
    assert largest == 1


@MARK
def test_empty_batch(name: str, env: Any) -> None:
    action, state = baselines.make(name, env).predict(np.empty((0, 10)))
    assert action.shape == (0, 1)
    assert len(state) == 0


@MARK
@pytest.mark.parametrize("spoil", [np.nan, np.inf, -np.inf])
def test_observations_that_are_not_finite(name: str, spoil: float, env: Any) -> None:
    controller, rows = baselines.make(name, env), observations(env)
    for i in range(rows.shape[1]):
        bad = rows.copy()
        bad[2, i] = spoil
        with pytest.raises(
            ValueError, match=r"`observation` must be finite, of shape \(10,\) or \(N, 10\) for a plant of"
        ):
            controller.predict(bad)
        with pytest.raises(ValueError, match="`observation` must be finite"):
            controller.predict(bad[2])


@MARK
@pytest.mark.parametrize("shape", [(), (0,), (9,), (11,), (6, 9), (2, 3, 10), (10, 1)])
def test_observations_of_the_wrong_shape(name: str, shape: tuple[int, ...], env: Any) -> None:
    with pytest.raises(ValueError, match=r"`observation` must be finite, of shape \(10,\) or \(N, 10\)"):
        baselines.make(name, env).predict(np.zeros(shape))


@MARK
def test_states_of_the_wrong_shape(name: str, env: Any) -> None:
    """A state for another number of episodes is not spread over them."""
    controller, rows = baselines.make(name, env), observations(env)
    _, state = controller.predict(rows)
    for wrong in (state[:1], state[:, :-1], np.column_stack([state, state])):
        with pytest.raises(ValueError, match="`state` must be what `predict` returned, of shape"):
            controller.predict(rows, wrong)


@MARK
def test_controllers_can_be_compared_and_kept_in_sets(name: str, env: Any) -> None:
    one, other = baselines.make(name, env), baselines.make(name, env)
    assert one != other
    assert [other, one].index(one) == 1
    assert len({one, other, one}) == 2


@MARK
def test_evaluate_policy_of_stable_baselines(name: str) -> None:
    """Any object with `predict` runs there, and earns what the rollout says; rewards pass through float32 and six digits."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = gym.make(CHAIN, horizon=0.5)
    controller = baselines.make(name, env)
    expected = baselines.rollout(env, controller).reward.sum()
    mean, deviation = evaluate_policy(controller, Monitor(env), n_eval_episodes=2)
    assert mean == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert deviation == 0


# -- options ----------------------------------------------------------------------------------------------------------------


def test_unknown_controller(env: Any) -> None:
    with pytest.raises(ValueError, match=r"`name` must be one of .*'mfc'.*, got 'fmc'"):
        baselines.make("fmc", env)


@MARK
def test_unknown_option(name: str, env: Any) -> None:
    with pytest.raises(ValueError, match=f"controller '{name}' does not take these options: .*'flavour'"):
        baselines.make(name, env, flavour="sweet")


ERRORS: list[tuple[dict[str, Any], str]] = [
    ({"k": [1.0, 3.0, -3.0]}, "`k` must make A - B k' Hurwitz"),
    ({"k_tilde": [-1.0, 3.0, 3.0]}, "`k_tilde` must make A - B k' Hurwitz"),
    ({"k": [1.0, 3.0]}, "`k` must be 3 finite numbers"),
    ({"k_tilde": [64.0, np.nan, 12.0]}, "`k_tilde` must be 3 finite numbers"),
    ({"k": [1.0, 3.0, 3.0], "model_poles": [-1, -1, -1]}, "`k` and `model_poles` must not be given together"),
    ({"k_tilde": [64.0, 48.0, 12.0], "poles": [-4, -4, -4]}, "`k_tilde` and `poles` must not be given together"),
    ({"model_poles": [-1, -1]}, "`model_poles` must be 3 poles"),
    ({"poles": [-1, -1, -1, -1]}, "`poles` must be 3 poles"),
    ({"poles": "a"}, "`poles` must be a list of numbers"),
    ({"model_poles": [-1, -1 + 1j, -2]}, "`model_poles` must be closed under conjugation"),
    ({"margin": "a"}, "`margin` must be positive and finite, got 'a'"),
    ({"rate": "a"}, "`rate` must be positive"),
    ({"delta_3": "a"}, "`delta_3` must be >= 0"),
    ({"gain": ["paper"]}, "`gain` must be one of"),
    ({"k": "abc"}, "`k` must be 3 finite numbers"),
    ({"P": "a"}, "`P` must be a symmetric matrix"),
    ({"initial_model_state": ("a", "b", "c")}, "`initial_model_state` must be 3 finite numbers"),
    ({"colour": 3}, "it takes model_poles, poles"),
    ({"poles": [-1, -1, 1]}, "`poles` must be a list of numbers with negative real part"),
    ({"poles": []}, "`poles` must be a list of numbers with negative real part"),
    ({"poles": -4.0}, "`poles` must be a list of numbers with negative real part"),
    ({"poles": [-1, -1 + 1j, -1]}, "`poles` must be closed under conjugation"),
    ({"design": "optimal"}, "`design` must be one of"),
    ({"P": np.diag([1.0, 1.0, -1.0])}, "`P` must be positive definite"),
    ({"P": np.eye(2)}, r"`P` must be a symmetric matrix of shape \(3, 3\)"),
    ({"P": np.triu(np.ones((3, 3)))}, r"`P` must be a symmetric matrix of shape \(3, 3\)"),
    ({"P": np.eye(3)}, "`dissipation of P` must be positive definite"),  # V = norm(e)^2 grows somewhere
    ({"design": "paper", "sliding_poles": [-2, -3]}, "`sliding_poles` must come with design = 'surface'"),
    ({"sliding_poles": [-2]}, "`sliding_poles` must be 2 poles"),
    ({"sliding_poles": [-40, -40], "poles": [-4, -4, -4]}, "`sliding_poles` must make c.* strictly positive real"),
    ({"gain": "huge"}, "`gain` must be one of"),
    ({"switching": "softly"}, "`switching` must be one of"),
    ({"initial_model_state": "plant"}, "`initial_model_state` must be one of"),
    ({"initial_model_state": [0.5, 0.0]}, "`initial_model_state` must be 3 finite numbers"),
    ({"initial_model_state": [0.5, 0.0, np.inf]}, "`initial_model_state` must be 3 finite numbers"),
    ({"delta_1": -1.0}, "`delta_1` must be >= 0 and finite"),
    ({"delta_1": np.nan}, "`delta_1` must be >= 0 and finite"),
    ({"delta_3": 1.0}, r"`delta_3` must lie in \[0, 1\)"),
    ({"delta_3": -0.1}, "`delta_3` must be >= 0 and finite"),
    ({"delta_3": np.nan}, "`delta_3` must be >= 0 and finite"),
    ({"margin": 0.0}, "`margin` must be positive and finite"),
    ({"margin": np.inf}, "`margin` must be positive and finite"),
    ({"width": -1.0}, "`width` must be positive and finite"),
    ({"rate": 0.0}, "`rate` must be positive and finite"),
    ({"rate": 1.5}, r"`rate` must lie in \(0, 1\]"),
]


@pytest.mark.parametrize(("options", "text"), ERRORS)
def test_options_that_cannot_work(options: dict[str, Any], text: str, env: Any) -> None:
    for name in FAMILY:
        with pytest.raises(ValueError, match=text):
            baselines.make(name, env, **options)


@pytest.mark.parametrize(("option", "value"), [("model", "cubic"), ("feedback", "telepathy")])
def test_parts_that_do_not_exist(option: str, value: str, env: Any) -> None:
    with pytest.raises(ValueError, match=f"`{option}` must be one of .*, got '{value}'"):
        baselines.make("mfc", env, **{option: value})


def test_gains_and_their_poles_are_one_design(env: Any) -> None:
    """And P given is P designed: k = [1, 3, 3], k_tilde = [64, 48, 12] and the matrix of the equal sliding poles."""
    by_poles = baselines.make("mfc", env, model_poles=(-1,) * 3, poles=(-4,) * 3, design="surface")
    by_gains = baselines.make(
        "mfc", env, k=[1, 3, 3], k_tilde=[64, 48, 12], P=[[768, 192, 16], [192, 80, 8], [16, 8, 1]]
    )
    rows = observations(env)
    np.testing.assert_array_equal(by_poles.predict(rows)[0], by_gains.predict(rows)[0])


def test_sliding_poles_are_those_of_the_surface(env: Any) -> None:
    """c = P B to the error of the Lyapunov solver, some eps cond(P) = 1e-12."""
    controller = baselines.make("mfc", env, sliding_poles=[-3, -5], poles=(-4,) * 3)
    c = controller.P[:, -1]  # type: ignore[attr-defined]
    np.testing.assert_allclose(c, [15, 8, 1], rtol=1e-11)


def test_bounds_given_replace_those_of_the_plant(env: Any) -> None:
    """u = v - Gamma sgn(w): by the theorem's rule Gamma = (delta_1 + delta_3 abs(v)) / (1 - delta_3). Rounding: a few eps."""
    row = observations(env)[0]
    options: dict[str, Any] = {
        "switching": "sign",
        "gain": "theorem",
        "margin": 1.0,
        "initial_model_state": "reference",
    }

    def u(**bounds: float) -> float:
        return 50.0 * float(baselines.make("mfc", env, **options, **bounds).predict(row)[0][0])

    free = u(delta_1=0.0, delta_3=0.0)
    for delta_1, delta_3 in ((1.0, 0.0), (0.0, 0.3), (2.0, 0.2)):
        Gamma = (delta_1 + delta_3 * abs(free)) / (1 - delta_3)
        assert abs(u(delta_1=delta_1, delta_3=delta_3) - free) == pytest.approx(Gamma, rel=1e-12)
    norm2 = (row[:3] ** 2).sum()  # the plant's own bounds: 1.25 abs(x)^2 and 0.25
    assert u() == pytest.approx(u(delta_1=1.25 * norm2, delta_3=0.25), rel=1e-12)
    assert u(delta_3=0.1) == pytest.approx(u(delta_1=1.25 * norm2, delta_3=0.1), rel=1e-12)


def test_vector_environment_makes_the_same_controller(env: Any) -> None:
    envs = gym.make_vec(CHAIN, num_envs=2, vectorization_mode="vector_entry_point")
    rows = observations(env)
    for name in baselines.names():
        one, other = baselines.make(name, env), baselines.make(name, envs)
        np.testing.assert_array_equal(one.predict(rows)[0], other.predict(rows)[0])
