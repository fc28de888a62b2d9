"""Roessler's oscillator, chaotic when left alone."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def rossler() -> FlatSystem:
    """x1' = -x2 - (1 + eps_k) x3, x2' = x1 + a (1 + eps_a) x2, x3' = b + x3 (x1 - c) + u, y = x2.

    Dimensionless. Uncertain (relative): the coupling eps_k and the growth rate eps_a.
    beta = -1; Delta_3 = eps_k. f(0) is not zero.

    Roessler's equations with the usual a = b = 0.2, c = 5.7: chaotic for u = 0.
    """
    x1, x2, x3 = x = sp.symbols("x1:4", real=True)
    a, b, c = sp.symbols("a b c", positive=True)
    eps_a, eps_k = sp.symbols("eps_a eps_k", real=True)
    g, k = 0.5, 0.3  # ends of the intervals of eps_a, eps_k
    return FlatSystem(
        name="Roessler",
        state=tuple(map(str, x)),
        f=(-x2 - x3, x1 + a * x2, b + x3 * (x1 - c)),
        g=(0, 0, 1),
        h=x2,
        Delta=(-eps_k * x3, eps_a * a * x2, 0),
        parameters={"a": 0.2, "b": 0.2, "c": 5.7},
        theta={"eps_a": (-g, g), "eps_k": (-k, k)},
        region={"x1": (-15, 15), "x2": (-15, 15), "x3": (-20, 20)},
        bounds={
            "delta_1": (  # triangle inequality on the coefficients of y''' in eps_k and eps_a
                k * abs(b + x3 * (x1 - c + a))
                + g * a * abs(2 * a * x1 + (3 * a**2 - 2) * x2 - x3)
                + g * k * a * abs(x3)
                + g**2 * a**2 * (abs(x1 + 3 * a * x2) + g * a * abs(x2))
            ),
            "delta_3": k,
            "delta_m": k * a * abs(x3) + g * a * (1 - a**2) * abs(x2),
        },
        task=Task(
            model_pole=2.0,
            process_pole=6.0,
            theta=(0.3, -0.25),
            initial_state=(1.0, 0.5, 0.0),
            initial_set={"x1": (1.0, 2.0), "x2": (-0.5, 0.5), "x3": (-0.5, 0.5)},
            input_limit=50.0,
            reference_rate=1.5,
            horizon=20.0,
            dt=0.01,
        ),
    )
