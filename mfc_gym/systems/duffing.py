"""Duffing's oscillator with two wells."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def duffing() -> FlatSystem:
    """x1' = (1 + eps_1) x2 + eps_x x1, x2' = k x1 - c (1 + eps_c) x1^3 - d x2 + u, y = x1.

    Dimensionless, k = 1, c = 1, d = 0.3. Uncertain: gain of the first integrator eps_1 (relative), its leakage or
    growth eps_x, cubic spring eps_c (relative, matched). beta = 1; Delta_3 = eps_1.
    """
    x1, x2 = x = sp.symbols("x1:3", real=True)
    k, c, d, eps_1, eps_x, eps_c = sp.symbols("k c d eps_1 eps_x eps_c", real=True)
    t, p, m = 0.3, 0.3, 0.3  # ends of the intervals of eps_1, eps_x, eps_c
    cubic = c * x1**3
    alpha = k * x1 - cubic - d * x2
    return FlatSystem(
        name="Duffing",
        state=tuple(map(str, x)),
        f=(x2, alpha),
        g=(0, 1),
        h=x1,
        Delta=(eps_1 * x2 + eps_x * x1, -eps_c * cubic),
        parameters={"k": 1.0, "c": 1.0, "d": 0.3},
        theta={"eps_1": (-t, t), "eps_x": (-p, p), "eps_c": (-m, m)},
        region={"x1": (-5, 5), "x2": (-15, 15)},
        bounds={  # y'' = (1 + eps_1) (alpha - eps_c cubic) + eps_x y'
            "delta_1": t * abs(alpha) + (1 + t) * m * abs(cubic) + p * ((1 + t) * abs(x2) + p * abs(x1)),
            "delta_3": t,
            "delta_m": m * abs(cubic),
            "sharp_1": t / (1 - t) * abs(alpha) + m * abs(cubic) + p * (abs(x2) + p / (1 - t) * abs(x1)),
            "sharp_3": t / (1 - t),
        },
        task=Task(
            model_pole=2.0,
            process_pole=10.0,
            theta=(-0.25, 0.3, 0.2),
            initial_state=(1.0, 0.0),
            initial_set={"x1": (-1.0, 1.0), "x2": (-1.0, 1.0)},
            input_limit=50.0,
            reference_scale=1.5,
            horizon=20.0,
            dt=0.01,
        ),
    )
