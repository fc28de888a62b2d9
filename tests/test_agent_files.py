"""Agent files: what is written is read back, and what could harm is refused with a sentence before any of it runs."""

import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.agent_files import DESCRIPTION, WEIGHTS, load_agent, save_agent
from baselines.interface import Interface
from baselines.observer import Observer
from baselines.policy_network import Agent, Features
from baselines.residual import Base

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from baselines.sb3_weights import agent_of, import_sb3_zip  # noqa: E402 (needs torch)

MARKER = "MFC_GYM_TEST_MARKER"


class Bomb:
    """Writes a file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {os.environ[MARKER]}",)


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "code_ran"
    monkeypatch.setenv(MARKER, str(path))
    return path


def an_agent(algorithm: str = "PPO", output: str = "clip") -> Agent:
    rng = np.random.default_rng(0)
    widths = (13, 16, 8, 1)
    layers = tuple((rng.normal(size=(b, a)).astype(np.float32).astype(float), np.zeros(b)) for a, b in pairwise(widths))
    features = Features(rng.normal(size=(13, 10)), rng.normal(size=13))
    environment = {
        "id": "mfc_gym/PerturbedChain-v0",
        "options": {"scenario": "random", "dt": 0.02, "theta": [0.5, -0.5]},
    }
    return Agent(
        algorithm,
        features,
        layers,
        "tanh",
        output,
        environment,
        {"seed": 0, "curve": [{"timesteps": 5, "return": -1.5}]},
    )


def a_residual_agent() -> Agent:
    """With everything the second format can state."""
    rng = np.random.default_rng(0)
    interface = Interface(
        Observer(integral=True, last_action=True, past=2, dt=0.02),
        Base("mfc", {"margin": 1.2, "switching": "sign", "poles": [-4.0, -4.0, -4.0]}, 0.2, (0.1, 0.2, 0.4)),
    )
    size = interface.size(10)
    layers = ((rng.normal(size=(8, 5)), np.zeros(8)), (rng.normal(size=(1, 8)), np.zeros(1)))
    features = Features(rng.normal(size=(5, size)), np.zeros(5))
    return replace(an_agent(), features=features, layers=layers, interface=interface)


@pytest.fixture
def residual(tmp_path: Path) -> Path:
    save_agent(a_residual_agent(), tmp_path / "residual")
    return tmp_path / "residual"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_agent(an_agent(), tmp_path / "agent")
    return tmp_path / "agent"


def test_what_is_saved_is_loaded(folder: Path, rng: np.random.Generator) -> None:
    saved, loaded = an_agent(), load_agent(folder)
    observations = rng.normal(size=(100, 10))
    assert np.array_equal(saved.predict(observations)[0], loaded.predict(observations)[0])
    assert (loaded.environment, loaded.training) == (saved.environment, saved.training)
    assert sorted(path.name for path in folder.iterdir()) == [DESCRIPTION, WEIGHTS]


def test_the_algorithm_can_be_asked_for(folder: Path) -> None:
    assert load_agent(folder, "ppo").algorithm == "PPO"
    with pytest.raises(ValueError, match="`algorithm` must be PPO"):
        load_agent(folder, "sac")


def test_the_agent_checks_its_observation(folder: Path) -> None:
    agent = load_agent(folder)
    assert agent.predict(np.zeros(10))[0].shape == (1,)
    for wrong in (np.zeros(9), np.full(10, np.nan), np.zeros((2, 2, 10))):
        with pytest.raises(ValueError, match="`observation` must be finite"):
            agent.predict(wrong)


def test_loading_needs_neither_torch_nor_stable_baselines(folder: Path) -> None:
    code = f"import sys; from baselines.agent_files import load_agent; load_agent({str(folder)!r})\n"
    code += "assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- twelve and more that are refused -------------------------------------------------------------------------------------


def describe(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the JSON of an agent."""
    data = json.loads((folder / DESCRIPTION).read_text())
    change(data)
    (folder / DESCRIPTION).write_text(json.dumps(data))


def weigh(folder: Path, data: bytes) -> None:
    """Change the weights of an agent, with the checksum a forger would write."""
    (folder / WEIGHTS).write_bytes(data)
    describe(folder, lambda d: d["weights"].update(sha256=hashlib.sha256(data).hexdigest()))


def tensors(folder: Path, **changed: Any) -> None:
    """Change tensors of an agent; None removes one."""
    from safetensors.numpy import load, save

    found = load((folder / WEIGHTS).read_bytes()) | {k.replace("_", "."): v for k, v in changed.items()}
    weigh(folder, save({k: np.ascontiguousarray(v) for k, v in found.items() if v is not None}))


def header(folder: Path, text: bytes) -> None:
    """A safetensors file with this header."""
    weigh(folder, len(text).to_bytes(8, "little") + text)


def pickled_weights(folder: Path) -> None:
    weigh(folder, pickle.dumps(Bomb()))


def torch_file_as_weights(folder: Path) -> None:
    stream = io.BytesIO()
    torch.save({"layers.0.weight": Bomb()}, stream)
    weigh(folder, stream.getvalue())


def pickled_description(folder: Path) -> None:
    (folder / DESCRIPTION).write_bytes(pickle.dumps(Bomb()))


def symbolic_link(folder: Path) -> None:
    (folder / WEIGHTS).rename(folder.parent / "elsewhere")
    (folder / WEIGHTS).symlink_to("../elsewhere")


def named_pipe(folder: Path) -> None:
    (folder / WEIGHTS).unlink()
    os.mkfifo(folder / WEIGHTS)


def oversized_file(folder: Path) -> None:
    with (folder / DESCRIPTION).open("wb") as file:
        file.truncate(2**33)  # sparse


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "pickle as weights": (pickled_weights, "must begin with a header"),
    "PyTorch file as weights": (torch_file_as_weights, "must begin with a header"),
    "pickle as JSON": (pickled_description, "must hold JSON"),
    "pickle in JSON": (lambda f: describe(f, lambda d: d.update(data={":serialized:": "gASV"})), "must have the keys"),
    "no JSON": (lambda f: (f / DESCRIPTION).write_text("name: agent"), "must hold JSON"),
    "deep JSON": (lambda f: (f / DESCRIPTION).write_text("[" * 200_000), "must hold JSON"),
    "nested training": (lambda f: describe(f, lambda d: d.update(training=[[[[[[[[[[1]]]]]]]]]])), "nested at most 8"),
    "key twice": (lambda f: (f / DESCRIPTION).write_text('{"a": 1, "a": 2}'), "a key that occurs twice"),
    "NaN in JSON": (lambda f: describe(f, lambda d: d["features"].update(offset=[float("nan")] * 13)), "the constant NaN"),
    "unknown key": (lambda f: describe(f, lambda d: d["network"].update(extractor="os.system")), "must have the keys"),
    "missing key": (lambda f: describe(f, lambda d: d.pop("environment")), "must have the keys"),
    "wrong algorithm": (lambda f: describe(f, lambda d: d.update(algorithm="A2C")), "agent.algorithm must be one of"),
    "unknown activation": (lambda f: describe(f, lambda d: d["network"].update(activation="os.system")), "must be one of"),
    "module in the id": (lambda f: describe(f, lambda d: d["environment"].update(id="os:mfc_gym/A-v0")), "must be text like"),
    "path in options": (
        lambda f: describe(f, lambda d: d["environment"]["options"].update(system="../../etc/plant.toml")),
        "must be text like",
    ),
    "path traversal": (lambda f: describe(f, lambda d: d["weights"].update(file="../other")), "must have the keys"),
    "huge width": (lambda f: describe(f, lambda d: d["network"].update(hidden=[10**9])), "an integer from 1 to 4096"),
    "ragged matrix": (lambda f: describe(f, lambda d: d["features"]["matrix"][0].pop()), "a matrix of equal rows"),
    "wrong shape": (lambda f: tensors(f, layers_0_weight=np.zeros((13, 16), np.float32)), "of shape"),
    "wrong dtype": (lambda f: tensors(f, layers_0_weight=np.zeros((16, 13))), "must be float32"),
    "NaN weights": (lambda f: tensors(f, layers_0_bias=np.full(16, np.nan, np.float32)), "must be finite"),
    "infinite weights": (lambda f: tensors(f, layers_0_bias=np.full(16, np.inf, np.float32)), "must be finite"),
    "missing tensor": (lambda f: tensors(f, layers_2_bias=None), "must hold the tensors"),
    "unknown tensor": (lambda f: tensors(f, layers_9_bias=np.zeros(1, np.float32)), "must hold the tensors"),
    "truncated": (lambda f: weigh(f, (f / WEIGHTS).read_bytes()[:-4]), "that its header declares"),
    "damaged": (lambda f: (f / WEIGHTS).write_bytes(b"0" * 1000), "must have the SHA-256"),
    "appended": (lambda f: weigh(f, (f / WEIGHTS).read_bytes() + b"0000"), "that its header declares"),
    "oversized tensor": (
        lambda f: header(f, b'{"layers.0.weight": {"dtype": "F32", "shape": [1000000, 1000000], "data_offsets": [0, 4]}}'),
        "must hold the tensors",
    ),
    "huge header": (lambda f: weigh(f, (2**40).to_bytes(8, "little") + b"{}"), "must begin with a header"),
    "empty": (lambda f: weigh(f, b""), "must begin with a header"),
    "header that is a list": (lambda f: header(f, b"[]"), "must hold the tensors"),
    "symbolic link": (symbolic_link, "a symbolic link"),
    "named pipe": (named_pipe, "another kind of file"),
    "no weights": (lambda f: (f / WEIGHTS).unlink(), "got none"),
    "oversized file": (oversized_file, "must have at most"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_a_sentence_and_nothing_runs(name: str, folder: Path, marker: Path) -> None:
    damage, message = REFUSED[name]
    damage(folder)
    with pytest.raises(ValueError, match=message) as caught:
        load_agent(folder)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 1000
    assert not marker.exists()


def test_overlapping_tensors_are_refused(folder: Path) -> None:
    """All tensors at the same bytes: the declared sizes fit, the file's layout does not."""
    data = (folder / WEIGHTS).read_bytes()
    size = int.from_bytes(data[:8], "little")
    entries = json.loads(data[8 : 8 + size])
    for entry in entries.values():
        entry["data_offsets"] = [0, 4]
    text = json.dumps(entries).encode()
    weigh(folder, len(text).to_bytes(8, "little") + text + data[8 + size :])
    with pytest.raises(ValueError, match="must be a safetensors file"):
        load_agent(folder)


# -- the second format: what is seen, and the controller that is corrected -------------------------------------------------


def base_of(**changes: Any) -> Callable[[Path], object]:
    return lambda f: describe(f, lambda d: d["base"].update(changes))


def observe_of(**changes: Any) -> Callable[[Path], object]:
    return lambda f: describe(f, lambda d: d["observe"].update(changes))


def old_format(folder: Path) -> None:
    describe(folder, lambda d: d.update(format="mfc-gym agent 1"))


REFUSED_RESIDUALS: dict[str, tuple[Callable[[Path], object], str]] = {
    "unknown controller": (base_of(controller="nobody"), "base.controller must be one of"),
    "module as controller": (base_of(controller="os:system"), "base.controller must be one of"),
    "list as controller": (base_of(controller=["mfc"]), "base.controller must be one of"),
    "path in options": (base_of(options={"P": "../../etc/passwd"}), "must be text like"),
    "object in options": (base_of(options={"P": {"__reduce__": "os.system"}}), "must be a number, a name or"),
    "key that is no name": (base_of(options={"k; import os": 1}), "must be text like"),
    "options that are a list": (base_of(options=["margin"]), "options must be an object"),
    "endless gains": (base_of(options={"k": [1.0] * 10**5}), "at most 16 of these"),
    "endless matrix": (base_of(options={"P": [[1.0] * 10**4]}), "at most 16 of these"),
    "many options": (base_of(options={f"k{i}": 1 for i in range(10**4)}), "at most 16 keys"),
    "no bound": (base_of(bound=None), "base.bound must be a number in"),
    "zero bound": (base_of(bound=0.0), "base.bound must be a number in"),
    "large bound": (base_of(bound=1e9), "base.bound must be a number in"),
    "bound that is true": (base_of(bound=True), "base.bound must be a number in"),
    "NaN bound": (base_of(bound=float("nan")), "the constant NaN"),
    "zero fade": (base_of(fade=[0.0, 1.0, 1.0]), "must be a number in"),
    "infinite fade": (base_of(fade=[1e400]), "the constant Infinity"),
    "endless fade": (base_of(fade=[1.0] * 10**5), "at most 16 numbers"),
    "unknown key of the base": (base_of(module="os"), "agent.base must have the keys"),
    "base that is a name": (lambda f: describe(f, lambda d: d.update(base="mfc")), "agent.base must have the keys"),
    "huge past": (observe_of(past=10**9), "an integer from 0 to 64"),
    "negative past": (observe_of(past=-1), "an integer from 0 to 64"),
    "past that is true": (observe_of(past=True), "an integer from 0 to 64"),
    "another past": (observe_of(past=3), "a column for each signal"),
    "text as flag": (observe_of(integral="yes"), "must be true or false"),
    "zero dt": (observe_of(dt=0.0), "observe.dt must be a number in"),
    "unknown word": (observe_of(theta=True), "agent.observe must have the keys"),
    "missing base": (lambda f: describe(f, lambda d: d.pop("base")), "agent must have the keys"),
    "first format with a base": (old_format, "agent must have the keys"),
    "unknown format": (lambda f: describe(f, lambda d: d.update(format="mfc-gym agent 3")), "agent.format must be one of"),
    "format that is a list": (lambda f: describe(f, lambda d: d.update(format=["x"])), "agent.format must be one of"),
    "narrow features": (
        lambda f: describe(f, lambda d: d["features"].update(matrix=[[1.0]] * 5)), "a column for each signal"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_RESIDUALS)
def test_residuals_refused_with_a_sentence(name: str, residual: Path, marker: Path) -> None:
    damage, message = REFUSED_RESIDUALS[name]
    damage(residual)
    with pytest.raises(ValueError, match=message) as caught:
        load_agent(residual)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 1000
    assert not marker.exists()


@pytest.mark.parametrize(
    "given",
    [
        {"nominal": 1}, {"name": "single-loop"}, {"colour": 3}, {"margin": "large"}, {"margin": [1.0]},
        {"k": "abc"}, {"k": [1.0]}, {"P": [[1.0, 2.0]]}, {"P": 1e299}, {"rate": 2.0}, {"switching": "os.system"},
        {"model": ["nonlinear"]}, {"poles": [[1.0]]}, {"initial_model_state": [1.0]}, {"design": 1}, {"model_poles": [True]},
    ],
)  # fmt: skip
def test_options_that_a_controller_does_not_take_are_refused_when_it_is_built(given: Any, residual: Path) -> None:
    """What the schema lets through is plain data; the controller refuses it with a sentence of its own."""
    import gymnasium as gym

    import mfc_gym  # noqa: F401

    base_of(options=given)(residual)
    agent = load_agent(residual)
    with pytest.raises(ValueError, match=r"must|take these options|could not convert"):
        agent.made_for(gym.make("mfc_gym/PerturbedChain-v0"))


def test_a_residual_is_saved_and_loaded(residual: Path) -> None:
    saved, loaded = a_residual_agent().interface, load_agent(residual).interface
    assert (loaded.observer, loaded.base) == (saved.observer, saved.base)
    assert loaded.controller is None


def test_the_first_format_is_still_read(folder: Path, rng: np.random.Generator) -> None:
    observations = rng.normal(size=(10, 10))
    expected = load_agent(folder).predict(observations)[0]

    def first(description: dict[str, Any]) -> None:
        description["format"] = "mfc-gym agent 1"
        del description["observe"], description["base"]

    describe(folder, first)
    assert np.array_equal(load_agent(folder).predict(observations)[0], expected)


def test_files_beside_the_two_are_never_opened(folder: Path, marker: Path) -> None:
    (folder / "data.pkl").write_bytes(pickle.dumps(Bomb()))
    load_agent(folder)
    assert not marker.exists()


def test_the_bomb_is_live(marker: Path) -> None:
    pickle.loads(pickle.dumps(Bomb()))
    assert marker.exists()


# -- Stable-Baselines3 ----------------------------------------------------------------------------------------------------


def a_model(algorithm: str) -> Any:
    import sb3_contrib
    import stable_baselines3
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Still(__import__("gymnasium").Env):  # type: ignore[misc]
        observation_space, action_space = spaces.Box(-9, 9, (10,)), spaces.Box(-1, 1, (1,))

    kind = getattr(stable_baselines3, algorithm, None) or getattr(sb3_contrib, algorithm)
    return kind("MlpPolicy", DummyVecEnv([Still]), device="cpu", seed=0, policy_kwargs={"net_arch": [16, 16]})


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TD3", "TQC", "CrossQ"])
def test_agent_and_zip_act_as_the_model(algorithm: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """To float32's rounding through three layers."""
    model = a_model(algorithm)
    with torch.no_grad():
        for name, tensor in model.policy.state_dict().items():
            if tensor.dtype.is_floating_point:
                tensor += torch.rand_like(tensor) / 4 if name.endswith("ra_var") else torch.randn_like(tensor) / 8
    observations = rng.normal(size=(64, 10)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    agent = agent_of(model, Features(np.eye(10), np.zeros(10)), {"id": "mfc_gym/PerturbedChain-v0", "options": {}}, {})
    assert np.abs(agent.predict(observations)[0] - expected).max() < 1e-5
    save_agent(agent, tmp_path / "agent")
    assert np.abs(load_agent(tmp_path / "agent").predict(observations)[0] - expected).max() < 1e-5
    model.save(tmp_path / "model.zip")
    activation = "tanh" if algorithm == "PPO" else "relu"
    with pytest.warns(UserWarning, match="weights only"):
        imported = import_sb3_zip(tmp_path / "model.zip", algorithm, activation, trust=True)
    assert np.array_equal(imported.predict(observations)[0], agent.predict(observations)[0])


def archive(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def torch_bytes(value: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(value, stream)
    return stream.getvalue()


NAN_ACTOR = {"action_net.weight": torch.full((1, 2), torch.nan), "action_net.bias": torch.ones(1)}

ZIPS: dict[str, tuple[Callable[[], dict[str, bytes]], str]] = {
    "pickle as weights": (lambda: {"policy.pth": pickle.dumps(Bomb())}, "must hold tensors only"),
    "pickle in the weights": (lambda: {"policy.pth": torch_bytes({"actor.mu.weight": Bomb()})}, "must hold tensors only"),
    "no tensors": (lambda: {"policy.pth": torch_bytes({"actor.mu.weight": 1})}, "a dictionary of tensors"),
    "no actor": (lambda: {"policy.pth": torch_bytes({"critic.weight": torch.ones(1, 1)})}, "1 to 9 finite layers"),
    "no weights": (lambda: {"../policy.pth": b"", "data": pickle.dumps(Bomb())}, "must be an SB3 .zip"),
    "NaN": (lambda: {"policy.pth": torch_bytes(NAN_ACTOR)}, "finite"),
    "a bomb of zeros": (lambda: {"policy.pth": bytes(2**28 + 1)}, "must have at most"),
}  # fmt: skip


@pytest.mark.parametrize("name", ZIPS)
@pytest.mark.filterwarnings("ignore:.*weights only")
def test_a_strangers_zip_runs_nothing(name: str, tmp_path: Path, marker: Path) -> None:
    members, message = ZIPS[name]
    path = archive(
        tmp_path / "agent.zip",
        {"data": pickle.dumps(Bomb()), "pytorch_variables.pth": pickle.dumps(Bomb())} | members(),
    )
    with pytest.raises(ValueError, match=message):
        import_sb3_zip(path, "PPO", "tanh", trust=True)
    assert not marker.exists()


def test_a_zip_needs_trust(tmp_path: Path, marker: Path) -> None:
    path = archive(tmp_path / "agent.zip", {"data": pickle.dumps(Bomb())})
    with pytest.raises(ValueError, match="`trust` must be True"):
        import_sb3_zip(path, "PPO", "tanh")
    with pytest.raises(ValueError, match="must be a folder"):
        load_agent(path)
    assert not marker.exists()


@pytest.mark.parametrize(("module", "package"), [("agent_files", "safetensors"), ("sb3_weights", "torch")])
def test_a_missing_package_is_named(module: str, package: str) -> None:
    code = f"import sys; sys.modules[{package!r}] = None\nimport gymnasium\n"
    code += f"try:\n    import baselines.{module}\nexcept gymnasium.error.DependencyNotInstalled as e:\n    print(e)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 'pip install -c constraints.txt -e ".[rl]"' in done.stdout
