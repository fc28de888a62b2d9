"""The disk cache of generated modules: other processes, other threads, no place to write, failures."""

import os
import pickle
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from mfc_gym import kernels, plant

TEXT = """from numba import njit


@njit(cache=True, nogil=True)
def twice(x):
    return 2.0 * x
"""
SCRIPT = f"""
import sys
import warnings
from mfc_gym import kernels

def source():
    print("generated")
    return {TEXT!r}

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    modules = [kernels.load(name, source) for name in ("mfc_test_1", "mfc_test_1", "mfc_test_2")]
assert modules[0] is modules[1] is not modules[2]
print(*(m.twice(2.0) for m in modules), len(caught), *(w.message for w in caught))
print("hits", sum(modules[0].twice.stats.cache_hits.values()))
"""


def run(script: str, cache: Path, **environment: str) -> str:
    """What a new process prints; it must not fail."""
    known = os.environ | {"MFC_GYM_CACHE": str(cache)} | environment
    return subprocess.run(
        [sys.executable, "-c", script], env=known, check=True, capture_output=True, text=True, timeout=300
    ).stdout


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache of this process; the modules it gave are forgotten again."""
    before = set(sys.modules)
    monkeypatch.setattr(kernels, "cache_directory", lambda: tmp_path)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("mfc_"):
            del sys.modules[name]


def test_the_second_process_compiles_nothing(tmp_path: Path) -> None:
    first, second = run(SCRIPT, tmp_path / "cache"), run(SCRIPT, tmp_path / "cache")
    assert first == "generated\ngenerated\n4.0 4.0 4.0 0\nhits 0\n"
    assert second == "4.0 4.0 4.0 0\nhits 1\n"
    assert (tmp_path / "cache").stat().st_mode & 0o77 == 0  # what is executed there belongs to the user alone


def test_two_processes_on_a_cold_cache(tmp_path: Path) -> None:
    known = os.environ | {"MFC_GYM_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", SCRIPT]
    both = [subprocess.Popen(command, env=known, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for process in both:
        out, _ = process.communicate(timeout=300)
        assert process.returncode == 0
        assert "4.0 4.0 4.0 0" in out
    assert {p.name: p.read_text() for p in tmp_path.glob("*.*")} == dict.fromkeys(
        ("mfc_test_1.py", "mfc_test_2.py"), TEXT
    )
    assert run(SCRIPT, tmp_path).startswith("4.0 4.0 4.0 0")


def test_threads_on_a_cold_cache(folder: Path) -> None:
    """One of them writes and compiles, all get the same module, complete."""
    start, calls, got = threading.Barrier(4), [], []

    def source() -> str:
        calls.append(1)
        return TEXT

    def work() -> None:
        start.wait()
        module = kernels.load("mfc_test_threads", source)
        got.append((module, module.twice(3.0)))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 1
    assert [value for _, value in got] == [6.0] * 4
    assert len({id(module) for module, _ in got}) == 1


def test_nowhere_to_write(tmp_path: Path) -> None:
    """Everything works, with one warning that says what to do."""
    (tmp_path / "file").touch()
    out = run(SCRIPT, tmp_path / "file" / "cache")
    text = "Kernels are compiled in every process, there is no writable cache: "
    assert out.startswith(f"generated\ngenerated\n4.0 4.0 4.0 1 {text}")
    assert out.endswith("Set MFC_GYM_CACHE to a writable folder.\nhits 0\n")


def test_an_environment_without_a_cache(tmp_path: Path) -> None:
    """The generated modules find one another, and two environments share them."""
    (tmp_path / "file").touch()
    script = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import gymnasium as gym, mfc_gym
    for _ in range(2):
        env = gym.make("mfc_gym/PerturbedChain-v0", order=2, substeps=1)
        env.reset(seed=0)
        reward = env.step(env.action_space.sample())[1]
print(len(caught), reward < 0)
"""
    assert run(script, tmp_path / "file" / "cache") == "1 True\n"


def test_where_the_cache_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MFC_GYM_CACHE, else below XDG_CACHE_HOME, else below ~/.cache; always absolute."""
    find = kernels.cache_directory.__wrapped__
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("MFC_GYM_CACHE", raising=False)
    assert find() == tmp_path / "home" / ".cache" / "mfc_gym"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert find() == tmp_path / "xdg" / "mfc_gym"
    monkeypatch.setenv("MFC_GYM_CACHE", "here")
    assert find() == tmp_path / "here"


def test_no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user without a home directory: as if it were not writable."""

    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("MFC_GYM_CACHE", raising=False)
    with pytest.warns(UserWarning, match="no writable cache: Could not determine home directory"):
        assert kernels.cache_directory.__wrapped__() is None


def test_a_failing_source_leaves_nothing_behind(folder: Path) -> None:
    def source() -> str:
        raise ValueError("no such plant")

    for _ in range(2):
        with pytest.raises(ValueError, match="no such plant"):
            kernels.load("mfc_test_failing", source)
    assert not list(folder.iterdir())
    assert "mfc_test_failing" not in sys.modules


@pytest.mark.parametrize("cached", [True, False])
def test_a_failing_module_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch, cached: bool) -> None:
    if not cached:
        monkeypatch.setattr(kernels, "cache_directory", lambda: None)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            kernels.load("mfc_test_broken", lambda: "1 / 0\n")
    assert "mfc_test_broken" not in sys.modules


def test_text_is_utf8_whatever_the_locale(tmp_path: Path) -> None:
    script = (
        "from mfc_gym import kernels\n"
        "print(ascii(kernels.load('mfc_test_utf8', lambda: 'NAME = \"R\\u00f6ssler\"').NAME))"
    )
    for _ in range(2):
        assert run(script, tmp_path, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0") == "'R\\xf6ssler'\n"


@pytest.mark.parametrize("cached", [True, False])
def test_a_module_pickles_as_its_source(folder: Path, monkeypatch: pytest.MonkeyPatch, cached: bool) -> None:
    """Another process needs neither the equations nor the same cache."""
    if not cached:
        monkeypatch.setattr(kernels, "cache_directory", lambda: None)
    module = kernels.load("mfc_test_pickle", lambda: TEXT)
    data = pickle.dumps(module)
    assert pickle.loads(data) is module
    script = f"import pickle\nm = pickle.loads({data!r})\nprint(m.__name__, m.twice(2.0))"
    assert run(script, folder / "other") == "mfc_test_pickle 4.0\n"


def test_keys_and_fingerprints(tmp_path: Path) -> None:
    """What differs has a different key, also where only the border between the parts differs."""
    assert len({kernels.key(*parts) for parts in (("a", "b"), ("ab",), ("a",), ("a", ""), ("b", "a"))}) == 5
    one, two = tmp_path / "one.py", tmp_path / "two.py"
    one.write_text("x = 1\n")
    two.write_text("x = 2\n")
    assert kernels.fingerprint(one) != kernels.fingerprint(two)
    assert all(path.exists() for path in kernels.files("mfc_gym", "references", "reward"))


def test_no_warning_with_a_warm_cache() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plant.load("PerturbedChain").kernel is plant.load("PerturbedChain").kernel
