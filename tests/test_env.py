"""The environment: the contracts of Gymnasium and Stable-Baselines3, physics, reward, clock, seeds, copies, errors."""

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3.common.env_checker as sb3_checker
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp

from mfc_gym import ENV_IDS, observation
from mfc_gym.env import TrackingEnv, scalar_action
from mfc_gym.references import REFERENCES

Array = NDArray[np.float64]
Make = Callable[..., TrackingEnv]
EPS = float(np.finfo(float).eps)
CHAIN = "mfc_gym/PerturbedChain-v0"
EVERYWHERE = pytest.mark.parametrize("scenario", ["paper", "random"])
EVERY_ID = pytest.mark.parametrize("env_id", ENV_IDS)


def actions(seed: int = 0) -> Iterator[NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    while True:
        yield rng.uniform(-1, 1, 1).astype(np.float32)


def run(env: TrackingEnv, policy: Iterator[Any], steps: int) -> tuple[Array, Array]:
    """Observations (N, 3n+1) and rewards (N,) of up to `steps` steps; N < steps if the episode ends."""
    seen, rewards = [], []
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(next(policy))
        seen.append(obs)
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(seen), np.array(rewards)


def always(value: float) -> Iterator[NDArray[np.float32]]:
    while True:
        yield np.array([value], np.float32)


# -- contracts --------------------------------------------------------------------------------------------------------


@EVERY_ID
@EVERYWHERE
def test_gymnasium_contract(env_id: str, scenario: str) -> None:
    """No error and no warning; rendering is checked with the chain, it is the same for all."""
    env = gym.make(env_id, scenario=scenario).unwrapped
    check_env(env, skip_render_check=env_id != CHAIN)


@EVERY_ID
@EVERYWHERE
def test_stable_baselines_contract(env_id: str, scenario: str) -> None:
    sb3_checker.check_env(gym.make(env_id, scenario=scenario))


@EVERY_ID
@EVERYWHERE
@pytest.mark.parametrize("policy", ["random", "up", "down"])
def test_observations_lie_strictly_inside_the_space(make: Make, env_id: str, scenario: str, policy: str) -> None:
    """Also at the end, and in the steps beyond it; types and shapes are those of the space."""
    env = make(env_id, scenario=scenario)
    low, high = env.observation_space.low, env.observation_space.high
    assert np.isfinite([low, high]).all()
    for seed in range(3):
        first, info = env.reset(seed=seed)
        assert info == {}
        source = {"random": actions(seed), "up": always(1.0), "down": always(-1.0)}[policy]
        seen, rewards = run(env, source, 300)
        beyond = np.array([env.step(next(source))[0] for _ in range(3)])
        for obs in (first, *seen, *beyond):
            assert obs.dtype == env.observation_space.dtype
            assert ((low < obs) & (obs < high)).all()
        assert (rewards <= 0).all()


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("order", [2, 4, 6])
def test_references_lie_inside_the_space(make: Make, reference: str, order: int) -> None:
    """Whatever is drawn, whatever the order of the derivatives."""
    env = make(order=order, reference=reference, scenario="random")
    high = env.observation_space.high[2 * order :]
    times = np.linspace(0, 20, 201)
    for seed in range(20):
        env.reset(seed=seed)
        drawn = REFERENCES[reference].evaluate(times, env.reference_parameters, order)
        assert (np.abs(drawn) < high).all()


@pytest.mark.parametrize("dt", [0.1, 0.5, 1.0])
def test_long_steps_stay_inside_the_space(make: Make, dt: float) -> None:
    """Also with one substep that would jump to infinity."""
    for substeps in (None, 1):
        env = make(dt=dt, substeps=substeps)
        for seed in range(5):
            env.reset(seed=seed)
            seen, _ = run(env, actions(seed), 20)
            assert all(env.observation_space.contains(obs) for obs in seen)


@EVERY_ID
def test_spaces(make: Make, env_id: str) -> None:
    """u / input_limit in a symmetric box; 3 n + 1 numbers that include twice the region."""
    env = make(env_id)
    n = env.nominal.order
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    assert env.observation_space.shape == (observation.size(n),)
    low, high = env.simulation.plant.region(env.simulation.input_limit)
    box = env.observation_space
    np.testing.assert_allclose(
        [box.low[:n], box.high[:n]], [1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low], rtol=4 * EPS
    )


def test_the_defaults_are_the_example_of_the_paper(make: Make) -> None:
    env = make()
    first, _ = env.reset()
    np.testing.assert_array_equal(first, [1, 0, 0, 1, 0, 0, 0, 1, 0, -1])  # x, xi_n, sin t and its derivatives
    np.testing.assert_array_equal(env.theta, [0.5, -0.5])
    assert (env.dt, env.simulation.horizon, env.simulation.input_limit) == (0.01, 20.0, 50.0)


# -- physics ----------------------------------------------------------------------------------------------------------


def held(env: TrackingEnv, x: Array, sequence: Array) -> Array:
    """The state after each of the actions: DOP853 under zero-order hold, shape (N, n)."""
    kernel, theta, limit = env.simulation.plant.kernel, env.theta, env.simulation.input_limit
    states = []
    for action in sequence:
        u = limit * float(np.clip(action, -1, 1))

        def field(t: float, z: Array, u: float = u) -> Array:
            flow = kernel.flow_at(z, theta)
            return flow[: z.size] + u * flow[z.size : 2 * z.size]

        x = solve_ivp(field, (0, env.dt), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("tolerance", [1e-8, 1e-11])
def test_state_is_that_of_an_independent_integration(make: Make, tolerance: float) -> None:
    """Each of 30 steps adds at most `tolerance`, which grows like exp(int abs(df/dx)): abs(x) stays below 3, hence
    abs(df/dx) < 1.5 + 2 * 3, over 0.3 s a factor of exp(2.25) < 10; DOP853 adds 30 * 1e-12 * 3."""
    env = make(tolerance=tolerance)
    x = env.reset()[0][:3]
    sequence = 0.3 * np.random.default_rng(1).uniform(-1, 1, 30).astype(np.float32)
    seen, _ = run(env, iter(sequence[:, None]), 30)
    exact = held(env, x, sequence)
    assert np.abs(exact).max() < 3
    assert np.abs(seen[:, :3] - exact).max() <= 10 * 30 * (tolerance + 3e-12)


@pytest.mark.parametrize("env_id", ["mfc_gym/FlexibleJoint-v0", "mfc_gym/Chua-v0", "mfc_gym/CSTR-v0"])
def test_states_of_other_plants(make: Make, env_id: str) -> None:
    """One step from each state of an episode: no error of an earlier step counts."""
    env = make(env_id, scenario="random")
    before, _ = env.reset(seed=3)
    n = env.nominal.order
    for action in np.random.default_rng(0).uniform(-1, 1, 20).astype(np.float32):
        after = env.step([action])[0]
        exact = held(env, before[:n], [action])[0]
        assert (np.abs(after[:n] - exact) <= 1.1e-8 * np.maximum(1, np.abs(exact))).all()  # 1e-9 for DOP853
        before = after


@EVERY_ID
def test_output_derivatives_are_tau_n(make: Make, env_id: str) -> None:
    """Bit for bit what the plant's own kernel says of the state that is observed."""
    env = make(env_id, scenario="random")
    first, _ = env.reset(seed=1)
    seen, _ = run(env, actions(), 20)
    for obs in (first, *seen):
        xi_n = env.simulation.plant.kernel.output_derivatives(*observation.state(obs), *env.theta)
        np.testing.assert_array_equal(observation.output_derivatives(obs), xi_n)


def test_output_derivatives_of_the_chain(make: Make) -> None:
    """y^(k) = p_k x_(k+1) with p = (1, 1.5, 0.75)."""
    env = make()
    env.reset()
    seen, _ = run(env, actions(), 50)
    np.testing.assert_allclose(seen[:, 3:6], seen[:, :3] * [1, 1.5, 0.75], rtol=4 * EPS)


def test_reference_is_that_of_the_clock(make: Make) -> None:
    """sin(k dt) and its derivatives after k steps, without accumulated error; the phase is rounded at most twice."""
    env = make()
    env.reset()
    seen, _ = run(env, always(-0.01), 60)
    assert len(seen) == 60
    t = 0.01 * np.arange(1, 61)[:, None]
    np.testing.assert_allclose(seen[:, 6:], np.sin(t + np.arange(4) * np.pi / 2), rtol=0, atol=4 * EPS)


def test_actions_are_saturated_and_held(make: Make) -> None:
    """Beyond [-1, 1] nothing changes; neither the array nor its type matters."""
    ends = []
    for action in ([1.0], [7.0], np.array([1], int), np.array([1.0]), np.array([3.0], np.float16)):
        env = make()
        env.reset()
        ends.append(env.step(action)[0])
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])


# -- reward and return ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cost", "power"), [("absolute", 1), ("quadratic", 2)])
def test_reward_formula(make: Make, cost: str, power: int) -> None:
    """-dt min(abs(y - y_d)^power + effort u^2, cost_max) at the end of the step; six operations."""
    env = make(cost=cost, effort=0.01, cost_max=2.0)
    env.reset()
    sequence = np.random.default_rng(0).uniform(-0.5, 0.5, 60).astype(np.float32)
    seen, rewards = run(env, iter(sequence[:, None]), 60)
    each = np.abs(seen[:, 3] - seen[:, 6]) ** power + 0.01 * (50.0 * sequence.astype(float)) ** 2
    assert (each < 2).any()
    assert (each > 2).any()
    np.testing.assert_allclose(rewards, -0.01 * np.minimum(each, 2.0), rtol=6 * EPS)


def test_the_return_is_minus_the_integral(make: Make) -> None:
    """The right-endpoint rule: return = -(int + dt/2 (c(T) - c(0)) + O(dt^2)). Slope 1, and 2 once that term is added;
    the error of a slope halves with dt."""
    x0, T, amplitude = np.array([0.0, 0.5, -1.0]), 1.0, 0.04  # y stays above y_d: the cost is smooth
    env = make(horizon=T, tolerance=1e-12)
    env.reset(options={"initial_state": x0})
    kernel, theta = env.simulation.plant.kernel, env.theta
    u = 50.0 * float(np.float32(amplitude))

    def field(t: float, z: Array) -> Array:
        flow = kernel.flow_at(z, theta)
        return flow[:3] + u * flow[3:6]

    path = solve_ivp(field, (0, T), x0, method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True).sol

    def cost(t: float) -> float:
        return abs(path(t)[0] - np.sin(t) - 2.0)

    integral = quad(cost, 0, T, epsabs=1e-12)[0]
    errors = []
    for dt in 0.1 * 0.5 ** np.arange(4):
        env = make(horizon=T, dt=float(dt), tolerance=1e-10, reference_parameters={"offset": 2.0})
        env.reset(options={"initial_state": x0})
        _, rewards = run(env, always(amplitude), 1000)
        errors.append([-rewards.sum() - integral, -rewards.sum() - integral - dt / 2 * (cost(T) - cost(0))])
    slopes = -np.diff(np.log2(np.abs(errors)), axis=0)
    for column, order in ((0, 1), (1, 2)):
        miss = np.abs(slopes[:, column] - order)
        assert miss[-1] < 0.05
        assert miss[-1] < 0.7 * miss[0]


def test_leaving_costs_the_rest_of_the_horizon(make: Make) -> None:
    env = make(cost_max=3.0)
    env.reset()
    seen, rewards = run(env, always(1.0), 2000)
    k = len(seen)
    assert k < 2000
    cost = abs(seen[-1, 3] - seen[-1, 6])
    assert rewards[-1] == pytest.approx(-0.01 * (min(cost, 3.0) + 3.0 * (2000 - k)), rel=8 * EPS)


@EVERY_ID
@EVERYWHERE
def test_leaving_never_pays(make: Make, env_id: str, scenario: str) -> None:
    """No way of staying until the horizon is worse: a step of staying costs at most dt cost_max."""
    env = make(env_id, scenario=scenario)
    settings = env.simulation.settings
    cost_max, steps = settings[4], int(settings[3])
    for direction in (-1.0, 1.0):
        env.reset(seed=0)
        seen, rewards = run(env, always(direction), steps)
        worst_of_staying = rewards[:-1].sum() - env.dt * cost_max * (steps - len(seen))
        assert rewards.sum() <= worst_of_staying * (1 - steps * EPS)
        assert -env.dt * cost_max * steps * (1 + steps * EPS) <= rewards.sum()


def test_steps_beyond_the_end_earn_nothing(make: Make) -> None:
    """They are not part of the episode; whoever takes them sees no reward above zero."""
    env = make(horizon=0.05)
    env.reset()
    steps = [env.step([1.0]) for _ in range(100)]
    assert any(terminated for _, _, terminated, _, _ in steps[5:])
    assert all(reward <= 0 for _, reward, _, _, _ in steps)


# -- the clock --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "horizon", "steps"), [(0.01, 0.05, 5), (0.1, 0.3, 3), (0.1, 0.7, 7), (0.05, 0.05, 1)])
def test_the_horizon_is_exact(make: Make, dt: float, horizon: float, steps: int) -> None:
    """The last step, and it alone, is truncated and not terminated."""
    env = make(dt=dt, horizon=horizon, initial_state=(0, 0, 0))
    for _ in range(2):
        env.reset()
        flags = [env.step([0.0])[2:4] for _ in range(steps)]
        assert flags == [(False, False)] * (steps - 1) + [(False, True)]


def test_leaving_at_the_horizon_is_terminated(make: Make) -> None:
    """Never both."""
    env = make()
    env.reset()
    k = len(run(env, always(1.0), 2000)[0])
    env = make(horizon=0.01 * k)
    env.reset()
    flags = [env.step([1.0])[2:4] for _ in range(k)]
    assert flags == [(False, False)] * (k - 1) + [(True, False)]
    env = make(horizon=0.01 * (k - 1))
    env.reset()
    flags = [env.step([1.0])[2:4] for _ in range(k - 1)]
    assert flags[-1] == (False, True)


@pytest.mark.parametrize("input_limit", [20.0, 50.0])
def test_the_state_of_no_return_terminates(make: Make, input_limit: float) -> None:
    """x_3' >= u + x_3^2: with u = input_limit, x_3 = 0 passes sqrt(input_limit) within pi / (4 sqrt(input_limit)), and
    beyond it not even u = -input_limit brings it back."""
    env = make(input_limit=input_limit)
    root = np.sqrt(input_limit)
    env.reset()
    seen, _ = run(env, always(1.0), 2000)
    assert (seen[:-1, 2] <= root).all()
    assert seen[-1, 2] > root
    assert len(seen) <= np.ceil(np.pi / (4 * root) / env.dt)
    x = seen[-1, :3]
    assert env.simulation.plant.kernel.field(*x, *env.theta, -input_limit)[2] > 0


def test_success(make: Make) -> None:
    """At the origin the chain rests: success on the horizon if the reference does so too."""
    for value, success in ((0.0, True), (0.04, True), (0.06, False)):
        env = make(horizon=0.1, initial_state=(0, 0, 0), reference="constant", reference_parameters={"value": value})
        env.reset()
        infos = [env.step([0.0])[4] for _ in range(10)]
        assert infos == [{}] * 9 + [{"is_success": success}]
    env = make(initial_state=(0, 0, 7.0), reference="constant", reference_parameters={"value": 0.0})
    env.reset()
    obs, _, terminated, _, info = env.step([1.0])  # at once out of the region, while y is still near y_d
    assert terminated
    assert abs(obs[3] - obs[6]) < 0.05
    assert info == {"is_success": False}


def test_types(make: Make) -> None:
    """Python's own, as both libraries demand."""
    env = make(horizon=0.01)
    env.reset()
    obs, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
    assert [type(v) for v in (obs, reward, terminated, truncated)] == [np.ndarray, float, bool, bool]
    assert type(info["is_success"]) is bool


# -- seeds and options ------------------------------------------------------------------------------------------------


def start(env: TrackingEnv, **keywords: Any) -> Array:
    """Everything that defines an episode."""
    first, _ = env.reset(**keywords)
    return np.concatenate([first, env.theta, env.reference_parameters])


@EVERY_ID
@EVERYWHERE
def test_same_seed_same_episode(make: Make, env_id: str, scenario: str) -> None:
    runs = []
    for _ in range(2):
        env = make(env_id, scenario=scenario)
        runs.append([start(env, seed=7), *run(env, actions(), 50)])
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_reset_without_a_seed_goes_on(make: Make) -> None:
    """Episode after episode differs, and the whole sequence repeats with its seed, whatever happens in between."""
    one, two = make(scenario="random"), make(scenario="random")
    first = [start(one, seed=5), *(start(one) for _ in range(4))]
    second = [start(two, seed=5)]
    for _ in range(4):
        run(two, actions(), 10)
        second.append(start(two))
    np.testing.assert_array_equal(first, second)
    assert len({tuple(s) for s in first}) == 5
    assert (start(one, seed=6) != first[0]).any()


def test_the_paper_has_nothing_random(make: Make) -> None:
    env = make()
    starts = [start(env, seed=1), start(env), start(env, seed=2)]
    np.testing.assert_array_equal(starts, [starts[0]] * 3)


def test_interleaved_environments_are_independent(make: Make) -> None:
    """Two that take turns do what each does alone; also of different orders and plants."""

    def fresh() -> list[TrackingEnv]:
        return [make(scenario="random"), make(order=4), make("mfc_gym/Duffing-v0", scenario="random")]

    alone = []
    for k, env in enumerate(fresh()):
        env.reset(seed=k)
        alone.append(run(env, actions(k), 30)[0])
    envs, sources = fresh(), [actions(k) for k in range(3)]
    for k, env in enumerate(envs):
        env.reset(seed=k)
    for step in range(30):
        for env, source, expected in zip(envs, sources, alone, strict=True):
            np.testing.assert_array_equal(env.step(next(source))[0], expected[step])


@EVERY_ID
def test_random_episodes_come_from_the_declared_sets(make: Make, env_id: str) -> None:
    """theta in its set and admissible, abs(Delta_3) <= delta_3; the initial state and the reference in theirs."""
    env = make(env_id, scenario="random")
    built, task, fixed = env.simulation.plant, env.simulation.plant.task, env.simulation.reference_parameters
    low, high = built.theta_set
    family = env.simulation.reference
    thetas = set()
    for seed in range(30):
        x = env.reset(seed=seed)[0][: built.order]
        assert ((low <= env.theta) & (env.theta <= high)).all()
        assert abs(built.kernel.uncertainty_at(x, env.theta)[1]) <= env.nominal.delta_3(x) * (1 + 1e-12)
        thetas.add(tuple(env.theta))
        for value, name, default in zip(x, built.state, env.simulation.initial_state, strict=True):
            a, b = task.initial_set.get(name, (default, default))
            assert a <= value <= b
        for value, (name, default) in zip(env.reference_parameters, family.defaults.items(), strict=True):
            given = fixed.get(name, default)
            a, b = (given, given) if name in fixed else family.sets.get(name, (given, given))
            assert a <= value <= b
    assert len(thetas) == 30


def test_what_the_constructor_fixes_is_not_drawn(make: Make) -> None:
    x0, theta = (0.1, 0.2, 0.3), (0.1, 0.1)
    env = make(scenario="random", initial_state=x0, theta=theta, reference_parameters={"amplitude": 0.75})
    starts = np.array([start(env, seed=seed) for seed in range(5)])
    np.testing.assert_array_equal(starts[:, [0, 1, 2, 10, 11, 12]], [[*x0, *theta, 0.75]] * 5)
    assert len(set(starts[:, 14])) == 5  # the phase


def test_the_options_of_a_reset_come_first(make: Make) -> None:
    """Before the constructor, before the draw; the rest is as it would have been, and the next episode again."""
    env = make(scenario="random", theta=(0.1, 0.1))
    plain = start(env, seed=3)
    following = start(env)
    options = {"initial_state": [0.5, 0, 0.25], "theta": (0.25, 0.0), "reference_parameters": {"phase": 1.5}}
    kept = copy.deepcopy(options)
    changed = start(env, seed=3, options=options)
    assert options == kept
    np.testing.assert_array_equal(changed[:3], [0.5, 0, 0.25])
    np.testing.assert_array_equal(changed[10:], [0.25, 0.0, *plain[12:14], 1.5, plain[15]])
    np.testing.assert_array_equal(start(env), following)
    np.testing.assert_array_equal(start(env, seed=3, options={}), plain)


def test_a_drawn_state_lies_in_the_region(make: Make) -> None:
    """A small input limit cuts the region of the chain at sqrt(0.04) = 0.2, inside the initial set of x_3."""
    env = make(scenario="random", input_limit=0.04)
    drawn = [env.reset(seed=seed)[0][2] for seed in range(50)]
    assert -0.5 <= min(drawn) < 0
    assert 0.1 < max(drawn) <= 0.2


def test_nothing_is_shared_between_observations(make: Make) -> None:
    """A caller may overwrite what it got, and what it gave."""
    plain, overwritten = make(), make()
    a, b = plain.reset()[0], overwritten.reset()[0]
    for action in np.random.default_rng(0).uniform(-0.2, 0.2, (20, 1)):
        b[:] = np.nan
        given = action.copy()
        a, last = plain.step(action)[0], b
        b = overwritten.step(given)[0]
        given[:] = 7.0
        assert not np.shares_memory(b, last)
        np.testing.assert_array_equal(a, b)
    theta = plain.theta
    theta[:] = 9.0
    np.testing.assert_array_equal(plain.theta, [0.5, -0.5])


# -- copies -----------------------------------------------------------------------------------------------------------


def test_a_specification_survives_json() -> None:
    keywords = {
        "order": 4,
        "theta": (0.25, 0.0, -0.25),
        "initial_state": (0.1, 0.2, 0.3, 0.4),
        "reference": "step",
        "reference_parameters": {"height": 0.5, "begin": 0.1},
        "dt": 0.02,
        "horizon": 1.0,
        "cost": "quadratic",
    }
    env = gym.make(CHAIN, **keywords)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    runs = []
    for e in (env, again):
        e.reset(seed=0)
        runs.append(run(e, actions(), 50))
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
def test_copies_go_on_alike_and_apart(duplicate: Callable[[gym.Env], gym.Env]) -> None:
    env = gym.make(CHAIN, scenario="random", render_mode="rgb_array")
    env.reset(seed=4)
    run(env, actions(), 5)
    env.render()
    twin = duplicate(env)
    np.testing.assert_array_equal(twin.unwrapped.theta, env.unwrapped.theta)
    mine = run(env, always(0.02), 10)[0]
    np.testing.assert_array_equal(run(twin, always(0.02), 10)[0], mine)
    np.testing.assert_array_equal(twin.reset()[0], env.reset()[0])
    np.testing.assert_array_equal(twin.render(), env.render())


def test_a_pickle_in_another_process(tmp_path: Any) -> None:
    env = gym.make(CHAIN, scenario="random")
    env.reset(seed=4)
    run(env, actions(), 5)
    (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
    script = "import pickle, sys; print(*pickle.load(open(sys.argv[1], 'rb')).step([0.0])[0].tolist())"
    command = [sys.executable, "-c", script, tmp_path / "env.pickle"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=300).stdout
    np.testing.assert_array_equal([float(v) for v in printed.split()], env.step([0.0])[0])


# -- errors -----------------------------------------------------------------------------------------------------------


def test_reset_comes_first(make: Make) -> None:
    env = make()
    for use in (lambda: env.step([0.0]), lambda: env.theta, lambda: env.reference_parameters):
        with pytest.raises(gym.error.ResetNeeded, match="reset"):
            use()
    with pytest.raises(gym.error.ResetNeeded):
        gym.make(CHAIN).step(np.zeros(1, np.float32))


BAD_ACTIONS = [
    *([np.nan], [np.inf], [-np.inf], np.array([np.nan], np.float32)),
    *(0.5, [], [0.1, 0.2], [[0.5]], np.zeros((1, 1))),
    *("1", ["1"], np.array(["1"]), b"1", None, [None], {0: 1.0}, {1.0}, object()),
    *([True], [1j], np.array([1 + 0j]), np.array([1], object), [10**400], [[1], [2, 3]]),
]


@pytest.mark.parametrize("action", BAD_ACTIONS, ids=lambda a: type(a).__name__)
def test_bad_actions(make: Make, action: Any) -> None:
    """Refused, and the episode is as it was."""
    env = make()
    env.reset()
    with pytest.raises(ValueError, match=r"`action` must be one finite number, shape \(1,\), got "):
        env.step(action)
    fresh = make()
    fresh.reset()
    np.testing.assert_array_equal(env.step([0.1])[0], fresh.step([0.1])[0])


def test_good_actions() -> None:
    for action in ([0.5], (0.5,), np.array([0.5]), np.array([0.5], np.float32), np.array([0.5], np.float16)):
        assert scalar_action(action) == 0.5
    assert scalar_action(np.array([1], np.uint8)) == 1.0


BAD_KEYWORDS: list[tuple[dict[str, Any], str]] = [
    ({"dt": -0.01}, "`dt` must be positive and finite, got -0.01"),
    ({"dt": 0}, "`dt` must be positive and finite, got 0"),
    ({"dt": True}, "`dt` must be positive and finite, got True"),
    ({"dt": "0.01"}, "`dt` must be positive and finite, got '0.01'"),
    ({"dt": np.inf}, "`dt` must be positive and finite, got inf"),
    ({"horizon": np.nan}, "`horizon` must be positive and finite, got nan"),
    ({"horizon": 0.015}, "`horizon` must be a multiple of `dt`, got horizon = 0.015 and dt = 0.01"),
    ({"horizon": 0.001}, "`horizon` must be a multiple of `dt`"),
    ({"horizon": 1e300, "dt": 1e-300}, "`horizon` must be a multiple of `dt`"),
    ({"dt": 2.0}, "`dt` must be small enough for an error of 1e-08 within 1024 substeps, got 2.0"),
    ({"input_limit": 0.0}, "`input_limit` must be positive and finite, got 0.0"),
    ({"cost_max": -1}, "`cost_max` must be positive and finite, got -1"),
    ({"effort": -1e-9}, "`effort` must be >= 0 and finite, got -1e-09"),
    ({"effort": "much"}, "`effort` must be >= 0 and finite, got 'much'"),
    ({"tolerance": 0.0}, "`tolerance` must be positive and finite, got 0.0"),
    ({"substeps": 0}, "`substeps` must be an integer from 1 to 1000000, got 0"),
    ({"substeps": 2.0}, "`substeps` must be an integer from 1 to 1000000, got 2.0"),
    ({"substeps": True}, "`substeps` must be an integer from 1 to 1000000, got True"),
    ({"scenario": "easy"}, r"`scenario` must be one of \['paper', 'random'\], got 'easy'"),
    ({"derivatives": "guessed"}, r"`derivatives` must be one of \[.*'exact'.*\], got 'guessed'"),
    ({"cost": "cubic"}, r"`cost` must be one of \['absolute', 'quadratic'\], got 'cubic'"),
    ({"cost": ["absolute"]}, r"`cost` must be one of .*, got \['absolute'\]"),
    ({"reference": "square"}, r"`reference` must be one of \['chirp', .*\], got 'square'"),
    ({"reference_parameters": {"height": 1.0}}, r"`reference_parameters` must be among .*, got \['height'\]"),
    ({"reference_parameters": {"phase": np.nan}}, "`reference_parameters` must be finite numbers, got phase = nan"),
    ({"reference_parameters": 3}, "`reference_parameters` must be a dict, got 3"),
    ({"theta": (0.5,)}, r"`theta` must be 2 finite numbers, got \(0.5,\)"),
    ({"theta": 0.5}, "`theta` must be 2 finite numbers, got 0.5"),
    ({"theta": ("0.5", "0")}, "`theta` must be 2 finite numbers, got"),
    ({"theta": (0.5, np.nan)}, "`theta` must be 2 finite numbers, got"),
    ({"theta": ((0.5, 0.5), (0.5,))}, "`theta` must be 2 finite numbers, got"),
    (
        {"theta": (0.5, 0.5)},
        r"`theta` must keep abs\(Delta_3\) <= delta_3 = 0.25, got theta = \(0.5, 0.5\) with Delta_3 = 1.25",
    ),
    ({"initial_state": (0, 0)}, r"`initial_state` must be 3 finite numbers, got \(0, 0\)"),
    ({"initial_state": (0, 0, 7.08)}, "`initial_state` must lie in the operating region .* got .*7.08"),
    ({"initial_state": (-11, 0, 0)}, "`initial_state` must lie in the operating region"),
    ({"render_mode": "ansi"}, r"`render_mode` must be one of \['rgb_array'\], got 'ansi'"),
    (
        {"colour": "red"},
        "neither the environment .* nor its system 'PerturbedChain' .* takes what is given: .*'colour'",
    ),
    ({"order": 1}, "`order` must be an integer from 2 to 32, got 1"),
    ({"rho": 0.0}, r"`theta` must keep abs\(Delta_3\) <= delta_3 = 0, got theta = \(0.5, -0.5\) with Delta_3 = -0.25"),
    ({"system": "Unknown"}, "`system` must be one of .*, got 'Unknown'"),
]


@pytest.mark.parametrize(
    ("keywords", "message"), BAD_KEYWORDS, ids=lambda v: repr(v)[:40] if isinstance(v, dict) else ""
)
def test_bad_keywords(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackingEnv(**keywords)


def test_gym_make_passes_errors_on() -> None:
    with pytest.raises(ValueError, match="`dt` must be positive and finite, got -1"):
        gym.make(CHAIN, dt=-1)


BAD_OPTIONS: list[tuple[Any, str]] = [
    (
        {"state": (0, 0, 0)},
        r"`options` must be among \('initial_state', 'theta', .*\), got \['state'\]",
    ),
    ({3: 4, "x": 5}, r"`options` must be among .*, got \['3', 'x'\]"),
    ([("theta", (0, 0))], "`options` must be a dict, got "),
    ({"theta": (0.5,)}, "`theta` must be 2 finite numbers, got"),
    ({"theta": (0.5, 0.5)}, r"`theta` must keep abs\(Delta_3\) <= delta_3 = 0.25"),
    ({"initial_state": None}, "`initial_state` must be 3 finite numbers, got None"),
    ({"initial_state": (0, 0, 9)}, "`initial_state` must lie in the operating region"),
    ({"reference_parameters": {"height": 1.0}}, "`reference_parameters` must be among"),
    ({"reference_parameters": {"phase": "late"}}, "`reference_parameters` must be finite numbers, got phase = 'late'"),
    ({"reference_parameters": 3}, "`reference_parameters` must be a dict, got 3"),
]


@EVERYWHERE
@pytest.mark.parametrize(
    ("options", "message"), BAD_OPTIONS, ids=lambda v: repr(v)[:40] if not isinstance(v, str) else ""
)
def test_bad_options(make: Make, scenario: str, options: Any, message: str) -> None:
    """Refused; the next reset is a plain one."""
    env = make(scenario=scenario)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options=options)
    plain = start(make(scenario=scenario), seed=1)
    np.testing.assert_array_equal(start(env, seed=1), plain)


def test_a_seed_is_a_python_integer(make: Make) -> None:
    with pytest.raises(gym.error.Error, match="Seed must be a python integer"):
        make().reset(seed=np.int64(3))
