"""The vector environment against scalar environments and Gymnasium's own SyncVectorEnv, bit for bit."""

import copy
import json
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.utils.env_match import check_environments_match
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import baselines
import mfc_gym
from mfc_gym import vector_env
from mfc_gym.env import TrackingEnv
from mfc_gym.stepping import BLOCK
from mfc_gym.vector_env import TrackingVectorEnv, spans

ID = "mfc_gym/PerturbedChain-v0"
SHORT = {"dt": 0.05, "horizon": 1.0}  # 20 steps; input_limit / dt is enough to leave the region before
CASES = {
    "paper": {},
    "random": {"scenario": "random"},
    "random, some fixed": {
        "scenario": "random",
        "reference": "multisine",
        "theta": (0.2, -0.3),
        "reference_parameters": {"phase2": 0.5},
    },
    "order 2": {"scenario": "random", "order": 2, "reference": "chirp", "cost": "quadratic", "effort": 1e-3},
    "sensors": {
        "scenario": "random",
        "derivatives": "ired",
        "sensors": {"noise": 0.01, "state_noise": 0.01, "distribution": "gaussian", "dropout": 0.1, "delay": 2},
    },
}
MODES = list(AutoresetMode)


def native(num_envs, mode=AutoresetMode.NEXT_STEP, **options):
    options = {**SHORT, **options}
    return gym.make_vec(ID, num_envs, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options)


def sync(num_envs, mode=AutoresetMode.NEXT_STEP, **options):
    options = {**SHORT, **options}
    return gym.make_vec(ID, num_envs, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options)


def same(a, b):
    """Bit for bit, dictionaries of arrays included."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if a.dtype == object:
        return all((x is None and y is None) or same(x, y) for x, y in zip(a, b, strict=True))
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def pushes(rng, steps, num_envs):
    """Actions, some out of range, that keep some environments inside and drive others out, each at its own time."""
    strength = rng.choice([0.02, 0.3, 1.5], num_envs)
    return strength[:, None] * rng.uniform(-0.5, 1.0, (steps, num_envs, 1)).astype(np.float32)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [0, 12345])
def test_equals_gymnasiums_sync_vector_env(case, mode, seed):
    """Every array and every info of every step, over several episodes that end at different times."""
    a, b = native(6, mode, **CASES[case]), sync(6, mode, **CASES[case])
    assert a.single_observation_space == b.single_observation_space
    assert a.observation_space == b.observation_space
    assert a.action_space == b.action_space
    assert a.metadata["autoreset_mode"] is mode
    assert same(a.reset(seed=seed)[0], b.reset(seed=seed)[0])
    ends = np.zeros(2, dtype=int)
    for actions in pushes(np.random.default_rng(seed), 100, 6):
        (*arrays, info), (*expected, expected_info) = a.step(actions), b.step(actions)
        assert all(same(x, y) for x, y in zip(arrays, expected, strict=True))
        assert same(info, expected_info)
        done = arrays[2] | arrays[3]
        ends += arrays[2].sum(), arrays[3].sum()
        if mode is AutoresetMode.DISABLED and done.any():
            assert same(a.reset(options={"reset_mask": done})[0], b.reset(options={"reset_mask": done})[0])
    assert (ends > 3).all(), f"too few terminated, truncated: {ends}"


@pytest.mark.parametrize("env_id", mfc_gym.ENV_IDS)
def test_equals_scalar_environments_of_every_plant(env_id):
    options = {"scenario": "random", "substeps": 3}
    envs = gym.make_vec(env_id, 3, vectorization_mode="vector_entry_point", **options)
    alone = [gym.make(env_id, **options) for _ in range(3)]
    observations, _ = envs.reset(seed=7)
    assert same(observations, np.array([env.reset(seed=7 + i)[0] for i, env in enumerate(alone)]))
    for actions in np.random.default_rng(0).uniform(-1, 1, (5, 3, 1)):
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        expected = [env.step(action)[:4] for env, action in zip(alone, actions, strict=True)]
        for i, values in enumerate(expected):
            assert same(observations[i], values[0])
            assert (rewards[i], terminated[i], truncated[i]) == values[1:]
        if (terminated | truncated).any():
            break


def test_one_environment_matches_gymnasiums_own_check():
    check_environments_match(native(1, scenario="random"), sync(1, scenario="random"), num_steps=60, seed=3)


# -- seeds ------------------------------------------------------------------------------------------------------------


def test_seeds_of_a_list_and_streams_that_go_on():
    envs, alone = native(4, scenario="random"), [TrackingEnv(**SHORT, scenario="random") for _ in range(4)]
    for seed in (5, None, None, [9, None, 3, None], None):
        seeds = [5, 6, 7, 8] if seed == 5 else [None] * 4 if seed is None else seed
        expected = [env.reset(seed=s)[0] for env, s in zip(alone, seeds, strict=True)]
        assert same(envs.reset(seed=seed)[0], np.array(expected))
    assert envs.unwrapped.np_random_seed == (9, 6, 3, 8)
    assert envs.unwrapped.np_random[2].random() == alone[2].np_random.random()


def test_without_a_seed_the_environments_differ():
    a, b = (native(3, scenario="random").reset()[0] for _ in range(2))
    assert len(np.unique(np.concatenate([a, b]), axis=0)) == 6


def test_no_random_stream_is_made_where_nothing_is_drawn(monkeypatch):
    """65536 environments of the paper's scenario: nothing is done for each of them in Python."""

    def forbidden(seed=None):
        raise AssertionError("a stream was made")

    envs = native(65536)
    monkeypatch.setattr(vector_env.seeding, "np_random", forbidden)
    observations, _ = envs.reset(seed=0)
    assert (observations == observations[0]).all()


@pytest.mark.parametrize("seed", [-1, 0.5, np.int64(3), [0, -1, 2]])
def test_bad_seeds_fail_as_in_gymnasium(seed):
    with pytest.raises(gym.error.Error, match=r"[Ss]eed must be"):
        native(3).reset(seed=seed)
    with pytest.raises(ValueError, match="`seed` must be an integer or 3 of them, got 2"):
        native(3).reset(seed=[0, 1])


# -- reset ------------------------------------------------------------------------------------------------------------


def test_options_for_all_and_for_each_environment():
    envs, rng = native(5, scenario="random"), np.random.default_rng(0)
    states, thetas, amplitudes = rng.uniform(-1, 1, (5, 3)), rng.uniform(-0.1, 0.1, (5, 2)), rng.uniform(0, 1, 5)
    shared = {"initial_state": [0.5, 0, 0], "theta": (0.1, -0.1), "reference_parameters": {"amplitude": 0.5}}
    each = {"initial_state": states, "theta": thetas, "reference_parameters": {"amplitude": amplitudes, "phase": 1.0}}
    for options in (shared, each):
        observations, _ = envs.reset(seed=0, options=options)
        for i in range(5):
            alone = TrackingEnv(**SHORT, scenario="random")
            own = shared if options is shared else {"initial_state": states[i], "theta": thetas[i]}
            if options is each:
                own["reference_parameters"] = {"amplitude": amplitudes[i], "phase": 1.0}
            assert same(observations[i], alone.reset(seed=i, options=own)[0])
            assert same(envs.unwrapped.theta[i], alone.theta)
            assert same(envs.unwrapped.reference_parameters[i], alone.reference_parameters)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", ["random", "sensors"])
def test_reset_mask_touches_nothing_else(mode, case):
    envs = native(5, mode, **CASES[case])
    envs.reset(seed=0)
    before = envs.step(np.full((5, 1), 0.01))[0]
    mask = np.array([False, True, False, True, False])
    states = np.arange(15).reshape(5, 3) / 10
    options = {"reset_mask": mask, "initial_state": states}
    observations, _ = envs.reset(options=options)
    assert options.keys() == {"reset_mask", "initial_state"}
    assert options["reset_mask"] is mask
    assert same(observations[~mask], before[~mask])
    assert case == "sensors" or same(observations[mask, :3], states[mask])


@pytest.mark.parametrize("scenario", ["paper", "random"])
def test_environments_can_be_reset_one_after_the_other(scenario):
    whole, parts = native(3, scenario=scenario), native(3, scenario=scenario)
    expected, _ = whole.reset(seed=0)
    for one in np.eye(3, dtype=bool):
        observations, _ = parts.reset(seed=0, options={"reset_mask": one})
        assert np.isnan(observations).any() == (not one[2])
        if not one[2]:
            with pytest.raises(gym.error.ResetNeeded):
                parts.step(np.zeros((3, 1)))
    assert same(observations, expected)
    assert same(parts.step(np.full((3, 1), 0.1))[0], whole.step(np.full((3, 1), 0.1))[0])


@pytest.mark.parametrize("num_envs", [3, 700])
def test_each_follows_its_own_reference(num_envs):
    """Also where most follow the usual one, which comes from a table; then all again. Few are copied, many are not."""
    envs, one = native(num_envs, threads=2), gym.make(ID, **SHORT)
    envs.reset(seed=0)
    mask, action = np.arange(num_envs) == 1, np.full((num_envs, 1), 0.01)
    for amplitude in (0.5, 1.0):
        chosen = {"reset_mask": mask} if amplitude != 1.0 else {}
        envs.reset(options={"reference_parameters": {"amplitude": amplitude}} | chosen)
        one.reset(options={"reference_parameters": {"amplitude": amplitude}})
        for _ in range(5):
            observations, rewards, *_ = envs.step(action)
            observation, reward, *_ = one.step([0.01])
            assert same(observations[1], observation)
            assert rewards[1] == reward
            assert same(observations[0, -4:] == observation[-4:], np.full(4, amplitude == 1.0))


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        ([True, False], TypeError),
        (np.array([1, 0]), TypeError),
        (np.ones(3, dtype=bool), ValueError),
        (np.zeros(2, dtype=bool), ValueError),
    ],
)
def test_bad_masks_fail_as_in_gymnasium(mask, error):
    envs, reference = native(2), sync(2)
    envs.reset()
    for env in (envs, reference):
        with pytest.raises(error, match="reset_mask"):
            env.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("mode", MODES)
def test_recorded_statistics(mode):
    """Vector RecordEpisodeStatistics adds up the returns and lengths of every episode, resets by mask included."""
    envs = RecordEpisodeStatistics(native(6, mode, scenario="random"), buffer_length=1000)
    envs.reset(seed=1)
    returns, lengths, fresh = np.zeros(6), np.zeros(6, dtype=int), np.zeros(6, dtype=bool)
    expected = []
    for actions in pushes(np.random.default_rng(1), 90, 6):
        _, rewards, terminated, truncated, info = envs.step(actions)
        returns, lengths = returns + rewards, lengths + ~fresh
        done = terminated | truncated
        if done.any():
            assert same(info["_episode"], done)
            assert np.array_equal(info["episode"]["r"][done], returns[done])
            assert np.array_equal(info["episode"]["l"][done], lengths[done])
        expected += list(zip(returns[done], lengths[done], strict=True))
        returns[done], lengths[done] = 0.0, 0
        fresh = done if mode is AutoresetMode.NEXT_STEP else np.zeros(6, dtype=bool)
        if mode is AutoresetMode.DISABLED and done.any():
            envs.reset(options={"reset_mask": done})
    assert len(expected) > 10
    assert list(zip(envs.return_queue, envs.length_queue, strict=True)) == expected


# -- step -------------------------------------------------------------------------------------------------------------


def test_the_clock_truncates_exactly_at_the_horizon():
    envs = native(2)
    envs.reset(options={"initial_state": [0, 0, 0], "theta": [0, 0]})
    for k in range(1, 21):
        _, _, terminated, truncated, info = envs.step(np.zeros((2, 1)))
        assert not terminated.any()
        assert (truncated == (k == 20)).all()
    assert same(info["_is_success"], truncated)
    assert same(info["is_success"], np.array([False, False]))


def test_action_of_a_step_that_resets_is_ignored():
    envs = native(2, scenario="random")
    envs.reset(seed=0)
    done = np.zeros(2, dtype=bool)
    while not done.any():
        _, _, terminated, truncated, _ = envs.step(np.array([[1.0], [0.0]]))
        done = terminated | truncated
    assert done.tolist() == [True, False]
    _, rewards, terminated, truncated, info = envs.step(np.array([[np.nan], [0.0]]))
    assert rewards[0] == 0.0
    assert rewards[1] < 0
    assert not (terminated | truncated).any()
    assert info == {}


@pytest.mark.parametrize("mode", MODES)
def test_results_are_fresh_and_nobody_elses(mode):
    """What a step returned stays as it is; writing into it changes nothing that follows."""
    kept, spoiled = (native(4, mode, scenario="random") for _ in range(2))
    memory = [kept.reset(seed=0)[0]]
    spoiled.reset(seed=0)[0][:] = np.nan
    copies = copy.deepcopy(memory)
    for actions in pushes(np.random.default_rng(0), 50, 4):
        *arrays, info = kept.step(actions)
        *others, spoiled_info = spoiled.step(actions)
        assert same(arrays[0], others[0])
        new = [*arrays, *(v for v in info.values() if isinstance(v, np.ndarray))]
        new += [x for x in info.get("final_obs", []) if x is not None]
        assert not any(np.shares_memory(x, y) for x in new for y in memory[-8:] if x.dtype != object != y.dtype)
        memory, copies = memory + new, copies + copy.deepcopy(new)
        done = arrays[2] | arrays[3]
        for array in (*others, *spoiled_info.values()):
            if isinstance(array, np.ndarray) and array.dtype != object:
                array[:] = True if array.dtype == bool else np.nan
        if mode is AutoresetMode.DISABLED and done.any():
            kept.reset(options={"reset_mask": done})
            spoiled.reset(options={"reset_mask": done})
    assert all(same(x, y) for x, y in zip(memory, copies, strict=True))


@pytest.mark.parametrize("num_envs", [1, BLOCK - 1, BLOCK, 2 * BLOCK + 1, 1000])
@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_spans_cover_every_environment_once(num_envs, count):
    covered = spans(num_envs, count)
    assert 1 <= len(covered) <= count
    assert covered[0][0] == 0
    assert covered[-1][1] == num_envs
    assert all(a[1] == b[0] for a, b in pairwise(covered))
    assert all(start % BLOCK == 0 for start, _ in covered)


def test_threads_and_batch_size_do_not_change_a_bit():
    num_envs, results = 2 * BLOCK + 7, []
    actions = pushes(np.random.default_rng(0), 40, num_envs)
    for threads, size in ((1, num_envs), (2, num_envs), (3, num_envs), (1, 5)):
        envs = native(size, scenario="random", threads=threads)
        steps = [envs.reset(seed=0)[0], *(np.c_[envs.step(a[:size])[:4]] for a in actions)]
        results.append([step[:5] for step in steps])
    for other in results[1:]:
        assert all(same(x, y) for x, y in zip(results[0], other, strict=True))


def test_a_copy_goes_on_alike_and_apart():
    envs = native(3, scenario="random")
    envs.reset(seed=0)
    twin = copy.deepcopy(envs)
    for actions in pushes(np.random.default_rng(0), 40, 3):
        assert same(envs.step(actions)[0], twin.step(actions)[0])


# -- controllers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_a_batch_rollout_equals_single_rollouts(mode):
    """Episodes of different lengths: from some of these states the law cannot keep the plant inside."""
    options = {"initial_state": np.array([[1, 0, 0], [4, 4, 6], [0, 0, 0], [-9, 5, 6.9]])}
    envs = native(4, mode, horizon=2.0)
    controller = baselines.make("mfc", envs)
    batch = baselines.rollout(envs, controller, seed=0, options=options)
    assert len(set(batch.steps)) > 1
    for i, episode in enumerate(batch.episodes()):
        alone = TrackingEnv(**{**SHORT, "horizon": 2.0})
        single = baselines.rollout(
            alone, baselines.make("mfc", alone), seed=i, options={"initial_state": options["initial_state"][i]}
        )
        for name in ("state", "output_derivatives", "reference", "control", "reward"):
            assert same(getattr(episode, name), getattr(single, name))
        assert episode.terminated == single.terminated


def test_properties():
    envs, alone = native(3).unwrapped, TrackingEnv(**SHORT)
    envs.reset(seed=0)
    alone.reset(seed=0)
    assert envs.dt == alone.dt == 0.05
    assert envs.nominal == alone.nominal
    assert envs.simulation.steps == 20
    assert same(envs.theta, np.tile(alone.theta, (3, 1)))
    assert same(envs.rows, np.tile(alone.rows, (3, 1)))
    envs.theta[:] = 9.0
    assert same(envs.theta[0], alone.theta)


# -- construction and errors ------------------------------------------------------------------------------------------


def test_made_again_from_its_specification():
    envs = native(2, "SameStep", order=2)
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(envs.spec.to_json()))
    assert json.loads(envs.spec.to_json())["kwargs"]["autoreset_mode"] == "SameStep"
    assert isinstance(again, TrackingVectorEnv)
    assert again.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert again.num_envs == 2
    assert again.single_observation_space == envs.single_observation_space


def test_metadata_is_the_instances_own():
    a, b = native(1, AutoresetMode.DISABLED), native(1)
    assert a.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert b.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert "autoreset_mode" not in TrackingEnv.metadata


@pytest.mark.parametrize(
    ("actions", "match"),
    [
        (np.zeros(3), r"`actions` must be 3 numbers, shape \(3, 1\)"),
        (np.zeros((3, 2)), r"shape \(3, 2\)"),
        (np.zeros((2, 1)), r"shape \(2, 1\)"),
        ([[0], [0, 1], [0]], "`actions` must be 3 numbers"),
        ([["a"], ["b"], ["c"]], "`actions` must be 3 numbers"),
        (np.array([[0], [np.nan], [np.inf]]), "finite, got nan for environment 1"),
        (np.array([[0], [1], [-np.inf]], dtype=np.float32), "finite, got -inf for environment 2"),
    ],
)
def test_bad_actions_change_nothing(actions, match):
    envs = native(3)
    envs.reset(seed=0)
    before = envs.unwrapped.rows
    with pytest.raises(ValueError, match=match):
        envs.step(actions)
    assert same(envs.unwrapped.rows, before)


def test_actions_of_other_types():
    results = []
    for dtype in (np.float64, np.float32, np.int64):
        envs = native(2)
        envs.reset(seed=0)
        actions = np.ones((2, 1), dtype=dtype)
        actions.flags.writeable = False
        results.append(envs.step(actions)[0])
    envs.reset(seed=0)
    results.append(envs.step([[1], [1]])[0])
    assert all(same(results[0], other) for other in results)


def test_a_reset_is_needed():
    envs = native(2)
    for use in (lambda: envs.step(np.zeros((2, 1))), lambda: envs.unwrapped.theta):
        with pytest.raises(gym.error.ResetNeeded, match="Call reset before step"):
            use()
    envs = native(3, AutoresetMode.DISABLED)
    envs.reset(options={"initial_state": np.array([[0, 0, 0], [0, 0, 7.0], [0, 0, 0]])})
    done = np.zeros(3, dtype=bool)
    while not done.any():
        _, _, terminated, truncated, _ = envs.step(np.array([[0], [1], [0]]))
        done = terminated | truncated
    with pytest.raises(gym.error.ResetNeeded, match="episode of environment 1 has ended"):
        envs.step(np.zeros((3, 1)))
    envs.reset(options={"reset_mask": done})
    envs.step(np.zeros((3, 1)))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"num_envs": 0}, "`num_envs` must be an integer >= 1, got 0"),
        ({"num_envs": 2, "threads": 0}, "`threads` must be an integer >= 1, got 0"),
        ({"num_envs": 2, "render_mode": "rgb_array"}, "`render_mode` must be None"),
        ({"num_envs": 2, "autoreset_mode": "sometimes"}, "`autoreset_mode` must be one of"),
        ({"num_envs": 2, "max_episode_steps": 10}, "`max_episode_steps` must be at least horizon / dt = 2000, got 10"),
        ({"num_envs": 2, "scenario": "none"}, "`scenario` must be one of"),
        ({"num_envs": 2, "mass": 3.0}, "mass"),
    ],
)
def test_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        TrackingVectorEnv(**options)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"state": [0, 0, 0]}, "`options` must be among"),
        (3, "`options` must be a dict"),
        ({"initial_state": np.zeros((3, 3))}, "`initial_state` must be 3 finite numbers, or 2 times 3"),
        ({"initial_state": np.array([[0, 0, 0], [0, 11, 0]])}, r"operating region .* in environment 1"),
        ({"theta": np.array([[0.0, 0.0], [0.5, 0.5]])}, r"`theta` must keep .* in environment 1"),
        ({"reference_parameters": {"amplitude": np.ones(3)}}, "`amplitude` of the reference must be one number or 2"),
        ({"reference_parameters": {"amplitude": np.array([1, np.nan])}}, "`reference_parameters` must be finite"),
        ({"reference_parameters": {"size": 1.0}}, "`reference_parameters` must be among"),
    ],
)
def test_bad_reset_options(options, match):
    envs = native(2)
    envs.reset(seed=0)
    before = envs.unwrapped.rows
    with pytest.raises(ValueError, match=match):
        envs.reset(options=options)
    assert same(envs.unwrapped.rows, before)


def test_infos_are_gymnasiums():
    """`data_equivalence` is what Gymnasium's own tests compare with."""
    a, b = native(3, AutoresetMode.SAME_STEP), sync(3, AutoresetMode.SAME_STEP)
    a.reset(seed=0)
    b.reset(seed=0)
    for _ in range(20):
        info, expected = a.step(np.full((3, 1), 0.5))[4], b.step(np.full((3, 1), 0.5))[4]
        assert data_equivalence({k: v for k, v in info.items() if k != "final_obs"},
                                {k: v for k, v in expected.items() if k != "final_obs"})  # fmt: skip
