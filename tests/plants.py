"""Plants that only the tests use; as `system="plants:name"` they reach the environment like any user's plant."""

from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task

x1, x2, x3 = sp.symbols("x1:4", real=True)


def oscillator() -> FlatSystem:
    """x1' = x2, x2' = -4 x1 - x2 + u: linear, nothing uncertain."""
    return FlatSystem(
        name="oscillator",
        state=("x1", "x2"),
        f=(x2, -4 * x1 - x2),
        g=(0, 1),
        h=x1,
        Delta=(0, 0),
        region={"x1": (-1, 1), "x2": (-2, 2)},
        bounds={"delta_1": 0, "delta_3": 0},
        task=Task(input_limit=1.0, horizon=1.0),
    )


def every_function() -> FlatSystem:
    """One of each expression that a plant may be made of; the name is text that no generated file may execute."""
    a, c, d = sp.symbols("a c d", real=True)
    return FlatSystem(
        name='"""\nraise SystemExit("the name was executed")\n"""',
        state=("x1", "x2", "x3"),
        f=(
            x2 + sp.tanh(x1) / 3,
            x3 * (2 + sp.sin(x1)) + sp.log(3 + x1**2) + sp.atan(x2) ** 9 + sp.Rational(1, 7) / (2 + x2**2) ** 3,
            sp.Abs(x3) * sp.cos(x2) + sp.sign(x1) + sp.Min(x1, x2, 1) - sp.Max(x3, -a) + sp.exp(-(x3**2)),
        ),
        g=(0, 0, sp.sqrt(1 + x2**2) / (1 + x1**2) + sp.pi),
        h=x1 + sp.sinh(x1) / 8,
        Delta=(c * x2 * sp.cosh(x1), d * (1 + x2**2) ** sp.Rational(-3, 2), c * d * x1**4),
        parameters={"a": 0.3},
        theta={"c": (-0.2, 0.2), "d": (-1.0, 1.0)},
        region={"x1": (-2, 2), "x2": (-2, 2), "x3": (-2, 2)},
        bounds={"delta_1": 1e3, "delta_3": 0.9},
        task=Task(theta=(0.1, 0.5)),
    )


def reciprocal() -> FlatSystem:
    """x2' = 1 / x1 + u: the equations divide by zero at the origin, which lies in the region."""
    return FlatSystem(
        name="reciprocal",
        state=("x1", "x2"),
        f=(x2, 1 / x1),
        g=(0, 1),
        h=x1,
        Delta=(0, 0),
        bounds={"delta_1": 0, "delta_3": 0},
        task=Task(initial_state=(1.0, 0.0), horizon=1.0),
    )


not_a_plant = 3


def integrated(
    kernel: Any, x: NDArray, theta: NDArray, u: float, h: float, substeps: int, low: NDArray, high: NDArray
) -> NDArray:
    """[state after the substeps, 1.0 if it stayed inside], shape (n+1,), by the compiled integrator of many."""
    out = np.empty((1, len(x) + 1))
    kernel.integrate_all(x[None], theta[None], np.array([u]), h, substeps, low, high, out)
    return np.asarray(out[0])
