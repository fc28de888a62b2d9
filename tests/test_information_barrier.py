"""What a controller may know: no import, no name, no number leads from it to the uncertainty, the reward, the environment."""

import ast
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import baselines
from baselines.lyapunov import Array
from mfc_gym import ENV_IDS

CHAIN = "mfc_gym/PerturbedChain-v0"
ROOT = Path(baselines.__file__).parents[1]
LAWS = ("redesign", "redesign_kernel", "gains", "switching", "lyapunov", "model_loop", "controller", "registry")
ALLOWED = {"mfc_gym.nominal", "mfc_gym.observation", "mfc_gym.kernels", "mfc_gym.checks"}
PACKAGES = ("mfc_gym", "baselines")
TRUTH = ("theta", "delta", "phi", "uncertain", "reward", "cost", "drift_true", "output_derivatives", "output_rate")


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


@cache
def imports(module: str) -> frozenset[str]:
    """Modules of the two packages that the module's text imports, anywhere in it."""
    path = ROOT / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {module}"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                found.add(name if is_module(name) else str(node.module))
    return frozenset(name for name in found if name.partition(".")[0] in PACKAGES)


def reachable(module: str) -> set[str]:
    """Everything of the two packages that the module imports, directly or not (the packages' own __init__ aside)."""
    seen, pending = set(), [module]
    while pending:
        for name in imports(pending.pop()) - seen:
            seen.add(name)
            pending.append(name)
    return seen


# -- imports ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", LAWS)
def test_laws_import_the_nominal_model_only(module: str) -> None:
    own = {name for name in reachable(f"baselines.{module}") if name.startswith("mfc_gym")}
    assert own <= ALLOWED


def test_every_registered_controller_is_behind_the_barrier() -> None:
    """All that the registry reaches: no environment, no plant, no reward, and no module of the observer's side."""
    names = reachable("baselines.registry")
    assert {f"baselines.{module}" for module in LAWS if module != "registry"} <= names
    assert {name for name in names if name.startswith("mfc_gym")} <= ALLOWED
    assert not names & {
        f"baselines.{name}" for name in ("closed_loop", "filippov", "rollout", "rollout_kernel", "metrics")
    }


def test_no_law_looks_for_modules_at_run_time() -> None:
    """The imports above are all there are."""
    for module in LAWS:
        text = (ROOT / "baselines" / f"{module}.py").read_text()
        for way in ("importlib", "__import__", "sys.modules", "eval(", "exec("):
            assert way not in text, f"{way} in {module}"


@pytest.mark.parametrize("name", baselines.names())
def test_compiled_laws_import_the_nominal_model_only(name: str) -> None:
    """The generated text, too: its modules are laws or the plant's nominal kernel."""
    env = gym.make(CHAIN, substeps=1)
    controller = baselines.make(name, env)
    kernel = getattr(controller, "kernel", None)
    if kernel is None:
        pytest.skip("not compiled")
    tree = ast.parse(Path(kernel.__file__).read_text())
    modules = {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    laws = {f"baselines.{module}" for module in LAWS}
    assert modules <= laws | {"numpy", "numba", "math", env.unwrapped.nominal.kernel.__name__}


# -- names ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_nominal_model_names_no_truth(env_id: str) -> None:
    """Neither the object nor its generated module has the uncertainty, its parameters or the reward; bounds are all there is."""
    env = gym.make(env_id, substeps=1)
    nominal, plant = env.unwrapped.nominal, env.unwrapped.simulation.plant
    bounds = {"delta_1", "delta_3"}
    public = {name for name in dir(nominal) if not name.startswith("_")} - bounds
    inside = {name for name in vars(nominal.kernel) if not name.startswith("__")}
    for name in public | inside:
        assert not any(word in name.lower() for word in TRUTH), name
    tree = ast.parse(Path(nominal.kernel.__file__).read_text())
    identifiers = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    identifiers |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    assert not identifiers & (set(plant.theta) | {f"theta{i + 1}" for i in range(len(plant.theta))})
    literals = " ".join(
        node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    assert not any(name in literals.split() for name in plant.theta)


def test_nominal_model_is_the_same_whatever_the_truth() -> None:
    """One module, one set of numbers, for every theta, initial state, reference, cost and horizon."""
    kinds: tuple[dict[str, Any], ...] = (
        {"theta": (0.5, -0.5)}, {"theta": (0.0, 0.2)}, {"initial_state": (0.5, 0.1, 0.0)}, {"reference": "step"},
        {"cost": "quadratic"}, {"horizon": 1.0}, {"scenario": "random"},
    )  # fmt: skip
    models = [gym.make(CHAIN, substeps=1, **kind).unwrapped.nominal for kind in kinds]
    x = np.random.default_rng(0).uniform(-2, 2, (10, 3))
    for model in models[1:]:
        assert model.kernel is models[0].kernel
        assert (model.dt, model.input_limit) == (models[0].dt, models[0].input_limit)
        for function in ("tau", "alpha", "beta", "delta_1", "delta_3", "f", "g"):
            np.testing.assert_array_equal(getattr(model, function)(x), getattr(models[0], function)(x))


# -- numbers --------------------------------------------------------------------------------------------------------------


def made(name: str, env: Any) -> Any:
    """The controller, unless it says that it knows the truth."""
    controller = baselines.make(name, env)
    if "true model" in controller.reads:
        pytest.skip("reads the true model, and says so")
    return controller


def sequence(count: int = 30) -> Array:
    """Observations as an episode might bring them, whatever the truth."""
    t = 0.01 * np.arange(count)[:, None]
    return np.hstack(
        [0.5 * np.cos(t + np.arange(3)), 0.4 * np.cos(1.1 * t + np.arange(3)), np.sin(t + np.arange(4) * np.pi / 2)]
    )


def actions(controller: Any, observations: Array) -> Array:
    state, out = None, []
    for row in observations:
        action, state = controller.predict(row, state)
        out.append(action)
    return np.array(out)


@pytest.mark.parametrize("name", baselines.names())
def test_action_depends_on_the_observation_only(name: str) -> None:
    """Two plants that behave differently behind the same observations: the same actions, to the last bit."""
    environments = [gym.make(CHAIN, theta=theta, substeps=1) for theta in ((0.5, -0.5), (-0.2, 0.1))]
    controllers = [made(name, env) for env in environments]
    ends = []
    for env in environments:  # the truth is at work: one input, two motions
        env.reset(seed=0, options={"initial_state": [0.5, 0.2, -0.1]})
        for _ in range(20):
            observation, *_ = env.step(np.array([0.1], dtype=np.float32))
        ends.append(observation)
    assert not np.allclose(ends[0], ends[1], rtol=0, atol=1e-3)
    seen = sequence()
    np.testing.assert_array_equal(actions(controllers[0], seen), actions(controllers[1], seen))


@pytest.mark.parametrize("name", baselines.names())
def test_action_does_not_follow_the_environment(name: str) -> None:
    """Resetting and stepping the environment that the controller was made for leaves its answers alone."""
    env = gym.make(CHAIN, scenario="random", substeps=1)
    controller, seen = made(name, env), sequence()
    expected = actions(controller, seen)
    for seed in (1, 2):
        env.reset(seed=seed)
        env.step(np.array([0.5], dtype=np.float32))
        np.testing.assert_array_equal(actions(controller, seen), expected)


@pytest.mark.parametrize("name", baselines.names())
def test_controller_uses_what_it_says_it_reads(name: str) -> None:
    """And no more: what is not declared may be anything. The reference is everybody's."""
    controller = made(name, gym.make(CHAIN, substeps=1))
    declared = {
        "state": slice(0, 3) if "state" in controller.reads else None,
        "output": slice(3, 4) if {"output", "output derivatives"} & set(controller.reads) else None,
        "output derivatives": slice(4, 6) if "output derivatives" in controller.reads else None,
    }
    seen = sequence()
    expected = actions(controller, seen)
    whole = {"state": slice(0, 3), "output": slice(3, 4), "output derivatives": slice(4, 6)}
    for signal, place in whole.items():
        other = seen.copy()
        other[:, place] += 0.1
        assert np.array_equal(actions(controller, other), expected) == (declared[signal] is None), signal
