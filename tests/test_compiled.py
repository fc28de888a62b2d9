"""Compiled functions without Numba: the same numbers, refusals instead of wrong memory, nothing imported that is not needed."""

import copy
import json
import os
import pickle
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_kernels import folder, run

from mfc_gym import compiled, kernels, machine_code
from mfc_gym.compiled import njit
from mfc_gym.env import TrackingEnv

__all__ = ["folder"]  # a fixture

SOURCE = """
from math import sin

import numpy as np
from mfc_gym.compiled import entry, method, njit
from mfc_gym.references import sine


@njit
def square(x):
    return x * x


@entry("float64(float64[:, ::1], boolean[::1], uint64[::1], int64, float64, boolean)")
def every_type(a, b, c, i, x, flag):
    total = x if flag else -x
    for j in range(a.shape[0]):
        for k in range(a.shape[1]):
            if b[j]:
                a[j, k] = square(a[j, k]) + sin(float(c[k])) + i
            total += a[j, k] * (j + 1) + k
    return total


@entry("int64(int64)")
def successor(i):
    return i + 1


@entry("boolean(float64)")
def is_positive(x):
    return x > 0.0


@entry("void(float64, float64[::1])")
def library(t, out):
    sine(t, np.array((1.0, 2.0, 3.0, 4.0)) if False else out[:4], out[4:])


@entry("float64(int64, int64)")
def divided(i, j):
    return i / j


@entry("float64(int64)")
def allocates(n):
    return np.ones(n).sum()


@method(1)
def quotient(memory, value):
    return memory[0] / value, False, False


@method(3)
def step(memory, value):
    memory[0] += value
    return memory[0] * memory[1], memory[0] > memory[2], value < 0.0
"""


@pytest.fixture
def module(folder: Path) -> Any:
    return kernels.load("mfc_test_compiled", lambda: SOURCE)


@given(
    shape=st.tuples(st.integers(0, 4), st.integers(0, 4)),
    seed=st.integers(0, 2**32 - 1),
    i=st.integers(-(2**40), 2**40),
    x=st.floats(allow_nan=False, allow_infinity=False, width=32),
    flag=st.booleans(),
)
def test_is_the_python_function(shape: tuple[int, int], seed: int, i: int, x: float, flag: bool) -> None:
    """Every type of argument and result, also arrays without an entry."""
    own = kernels.load("mfc_test_compiled_kept", lambda: SOURCE)
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=shape), rng.random(shape[0]) < 0.5
    c = rng.integers(0, 2**40, shape[1], dtype=np.uint64)
    other = a.copy()
    expected = own.every_type.py_func(other, b, c, i, x, flag)
    assert own.every_type(a, b, c, i, x, flag) == pytest.approx(expected, rel=1e-12, abs=1e-9)
    np.testing.assert_allclose(a, other, rtol=1e-14)
    assert own.successor(i) == i + 1
    assert own.is_positive(x) is (x > 0)


def test_a_bound_entry_is_the_entry(module: Any) -> None:
    a, b, c = np.ones((2, 3)), np.ones(2, bool), np.arange(3, dtype=np.uint64)
    expected = module.every_type(a.copy(), b, c, 3, 0.5, True)
    bound = module.every_type.bind(a.copy(), b)
    assert bound.bind(c, 3)(0.5, True) == expected


@pytest.mark.parametrize(
    ("name", "arguments", "error", "message"),
    [
        ("every_type", (np.ones((2, 3), np.float32),), TypeError, "float64"),
        ("every_type", (np.ones(3),), TypeError, "2 axes"),
        ("every_type", (np.ones((3, 2)).T,), TypeError, "C contiguous"),
        ("every_type", (np.broadcast_to(1.0, (2, 3)),), TypeError, "writable"),
        ("every_type", (np.ones((2, 3)),), TypeError, "6 arguments, got fewer"),
        ("successor", (1, 2), TypeError, "1 arguments, got more"),
        ("successor", (), TypeError, "1 arguments, got fewer"),
    ],
)
def test_refuses_other_arguments(module: Any, name: str, arguments: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        getattr(module, name)(*arguments)


def test_read_only_arrays_are_refused(module: Any) -> None:
    frozen = np.ones(5)
    frozen.flags.writeable = False
    with pytest.raises(TypeError, match="writable"):
        module.library(0.0, frozen)


def test_an_error_inside_is_an_error_outside(module: Any) -> None:
    assert module.divided(1, 4) == 0.25
    with pytest.raises(ArithmeticError, match="divided"):
        module.divided(1, 0)


def test_memory_must_not_be_allocated(module: Any) -> None:
    with pytest.raises(RuntimeError, match=r"allocates must not call.*NRT_"):
        module.allocates(3)


def test_a_method_is_the_python_function(module: Any) -> None:
    memory, other = np.array([0.0, 2.0, 1.0]), np.array([0.0, 2.0, 1.0])
    step = module.step.bind(memory)
    for value in (0.5, 0.75, -3.0, 1e300):
        assert step(value) == module.step.py_func(other, value)
    np.testing.assert_array_equal(memory, other)
    with pytest.raises(TypeError, match="3"):
        module.step.bind(np.zeros(4))


def test_an_error_in_a_method_is_raised(module: Any) -> None:
    step = module.quotient.bind(np.array([1.0]))
    assert step(4.0) == (0.25, False, False)
    with pytest.raises(SystemError):
        step(0.0)
    assert step(2.0) == (0.5, False, False)


def test_a_step_that_fails_is_an_error() -> None:
    """dt^2 is 0: the differentiator divides by it."""
    env = gym.make(
        "mfc_gym/PerturbedChain-v0", dt=1e-170, horizon=1e-168, substeps=1, derivatives="ired", disable_env_checker=True
    )
    env.reset()
    with pytest.raises(ArithmeticError, match="compiled step failed"):
        env.step(np.array([0.5]))


def test_a_cache_that_fails_later_costs_a_warning(module: Any, folder: Path) -> None:
    path = folder / f"mfc_test_compiled.successor.{machine_code.key()}.o"
    path.mkdir()
    with pytest.warns(UserWarning, match="not kept"):
        assert module.successor(1) == 2
    assert not list(folder.glob("*.tmp"))


def test_a_method_keeps_no_memory(module: Any) -> None:
    """Its results are freed: 100 000 calls leave no more objects than one."""
    step = module.step.bind(np.zeros(3))
    step(0.5)
    before = sys.getallocatedblocks()
    for _ in range(100_000):
        step(0.5)
    assert sys.getallocatedblocks() - before < 1000


def test_a_damaged_file_is_compiled_again(module: Any, folder: Path) -> None:
    assert module.successor(1) == 2
    (path,) = folder.glob("mfc_test_compiled.successor.*.o")
    for damaged in (b"", b"no code", path.read_bytes()[:100]):
        path.write_bytes(damaged)
        again = compiled.Entry(module.successor.py_func, "int64(int64)", {})
        assert again(1) == 2
        assert machine_code.read(path) is not None


def test_functions_are_copied_and_sent_by_name() -> None:
    from mfc_gym.references import sine

    assert pickle.loads(pickle.dumps(sine)) is sine
    assert copy.deepcopy(sine) is sine


def test_njit_is_numbas(module: Any) -> None:
    assert module.square(3.0) == 9.0
    assert module.square.__name__ == "square"

    @njit(error_model="numpy")
    def inverse(x):  # type: ignore[no-untyped-def]
        """1/x."""
        return 1.0 / x

    assert inverse(0.0) == np.inf
    assert inverse.__doc__ == "1/x."


FIRST_STEP = """
import sys
import gymnasium as gym
import numpy as np
import mfc_gym
env = gym.make("mfc_gym/PerturbedChain-v0", scenario="random", {options})
env.reset(seed=0)
envs = gym.make_vec(
    "mfc_gym/PerturbedChain-v0", num_envs=2, vectorization_mode="vector_entry_point", scenario="random", {options}
)
envs.reset(seed=0)
print(env.step(np.array([0.5]))[0].tolist(), envs.step(np.array([[0.5], [0.5]]))[0][0].tolist())
print(sorted({{"numba", "scipy", "sympy"}} & set(sys.modules)))
"""


@pytest.mark.parametrize("options", ["", "derivatives='ired', actuator={'lag': 0.01}"])
def test_a_first_step_needs_no_compiler_once_it_is_compiled(tmp_path: Path, options: str) -> None:
    """And the numbers are the same: compiled now, loaded, and without a cache."""
    script = FIRST_STEP.format(options=options)
    cold, warm = run(script, tmp_path).splitlines(), run(script, tmp_path).splitlines()
    assert "numba" in cold[1]
    assert warm == [cold[0], "[]"]


def test_interpreted_it_is_the_same_to_rounding(tmp_path: Path) -> None:
    """With NUMBA_DISABLE_JIT every function is Python's own."""
    script = FIRST_STEP.format(options="substeps=1")
    compiled_, interpreted = (run(script, tmp_path, NUMBA_DISABLE_JIT=value).splitlines()[0] for value in "01")
    numbers = [json.loads("[" + text.replace("] [", "], [") + "]") for text in (compiled_, interpreted)]
    np.testing.assert_allclose(*numbers, rtol=1e-12, atol=1e-14)


def test_copies_of_an_environment_are_their_own(make: Any) -> None:
    """The compiled step refers to one memory; a copy, and what comes back from a pickle, has another."""
    env: TrackingEnv = make(scenario="random")
    env.reset(seed=0)
    env.step([0.5])
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = [env.step([u])[0] for u in (0.1, -0.2)]
    for other in copies:
        for u, observation in zip((0.1, -0.2), expected, strict=True):
            np.testing.assert_array_equal(other.step([u])[0], observation)


def test_no_leftovers_in_the_cache(module: Any, folder: Path) -> None:
    module.successor(1)
    assert not list(folder.glob("*.tmp"))
    assert os.stat(next(folder.glob("*.o"))).st_mode & 0o077 == 0
