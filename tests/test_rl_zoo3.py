"""The table of hyperparameters reads in YAML as it is written in Python."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

torch = pytest.importorskip("torch")
yaml = pytest.importorskip("yaml")
pytest.importorskip("sb3_contrib")

from stable_baselines3.common.env_util import make_vec_env  # noqa: E402

from baselines import hyperparameters, rl_zoo3  # noqa: E402
from baselines.hyperparameters import HYPERPARAMETERS, PLANTS  # noqa: E402
from baselines.learner import ACTIVATIONS, ALGORITHMS  # noqa: E402
from baselines.training_env import SCALING, TrainingEnv, features, scaled  # noqa: E402
from scripts import export_hyperparameters  # noqa: E402

CASES = [(a, env) for a in HYPERPARAMETERS for env in rl_zoo3.entries(a)]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("rl_zoo3")
    export_hyperparameters.main(export_hyperparameters.Arguments(out))
    return {path.stem: yaml.safe_load(path.read_text()) for path in sorted(Path(out).glob("*.yml"))}


def test_there_is_a_file_for_each_algorithm(files: dict[str, Any]) -> None:
    assert set(files) == set(HYPERPARAMETERS)


@pytest.mark.parametrize(("algorithm", "env"), CASES)
def test_yaml_holds_the_values_of_the_table(algorithm: str, env: str, files: dict[str, Any]) -> None:
    read, given = files[algorithm][env], hyperparameters.hyperparameters(algorithm, env)
    assert read == rl_zoo3.entry(algorithm, env)
    assert {name: read[name] for name in given.options} == given.options
    assert (read["n_envs"], read["n_timesteps"]) == (given.num_envs, given.timesteps)
    assert float(str(read["learning_rate"]).removeprefix("lin_")) == given.learning_rate
    assert read.get("noise_std", 0.0) == given.noise
    policy = eval(read["policy_kwargs"], {"nn": torch.nn})  # as rl_zoo3 does
    assert policy["activation_fn"] is ACTIVATIONS[given.activation]
    assert tuple(policy["net_arch"]) == given.hidden


@pytest.mark.parametrize(("algorithm", "env"), CASES)
def test_the_algorithm_is_built_from_the_file(algorithm: str, env: str, files: dict[str, Any]) -> None:
    """All that is left when rl_zoo3 has taken its own words out is an argument of the algorithm."""
    read = dict(files[algorithm][env])
    venv = make_vec_env(env, 2, env_kwargs=read.pop("env_kwargs"))
    ((name, keywords),) = read.pop("vec_env_wrapper").items()
    assert name == f"{scaled.__module__}.{scaled.__name__}"
    wrapped = scaled(venv, **keywords)
    for word in ("n_envs", "n_timesteps", "noise_type", "noise_std", "learning_rate"):
        read.pop(word, None)
    read["policy_kwargs"] = eval(read["policy_kwargs"], {"nn": torch.nn})
    short = {"buffer_size": 100, "batch_size": 2} if "buffer_size" in read else {"batch_size": 2}
    ALGORITHMS[algorithm](env=wrapped, **{**read, **short})


def test_scalar_environments_are_scaled_as_the_native_ones() -> None:
    env, task = rl_zoo3.CHAIN, {"scenario": "random", "dt": 0.02}
    venv = make_vec_env(env, 2, env_kwargs={**task, "horizon": 3.0})
    found = scaled(venv, gamma=0.98, horizon=10.0)
    assert isinstance(found, TrainingEnv)
    seen = features(env, {**task, "horizon": 10.0}, SCALING)
    assert np.array_equal(found.features.matrix, seen.matrix)
    assert found.reset().dtype == np.float32


@pytest.mark.parametrize("number", [1e-5, 1e22, 2.5e-7, 0.0007, -3.0, 0.0])
def test_yaml_reads_every_float_as_one(number: float) -> None:
    assert yaml.safe_load(rl_zoo3.to_yaml({"a": {"b": number}})) == {"a": {"b": number}}


def test_a_plant_overrides_what_it_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mappings are merged, the rest is replaced; other plants and algorithms keep theirs."""
    monkeypatch.setitem(PLANTS, "other", {"sac": {"timesteps": 7, "options": {"gamma": 0.5}}})
    plain, other = HYPERPARAMETERS["sac"], hyperparameters.hyperparameters("sac", "other")
    assert other.timesteps == 7
    assert other.options == {**plain.options, "gamma": 0.5}
    assert other.learning_rate == plain.learning_rate
    assert hyperparameters.hyperparameters("sac", rl_zoo3.CHAIN) == plain
    assert hyperparameters.hyperparameters("ppo", "other") == HYPERPARAMETERS["ppo"]


def test_every_plant_of_the_table_exists() -> None:
    for env, given in PLANTS.items():
        assert env in gym.registry
        assert set(given) <= set(HYPERPARAMETERS)
