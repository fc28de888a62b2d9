"""Chua's circuit with a cubic resistor, chaotic when left alone."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def chua() -> FlatSystem:
    """x1' = A (1 + eps_A) (x2 - N(x1)), x2' = x1 - x2 + x3, x3' = -B (1 + eps_B) x2 + u, N = (2 x1^3 - x1) / 7, y = x1.

    Dimensionless. Uncertain (relative): ratio of the capacitors eps_A, reciprocal of the inductance eps_B (matched).
    beta = A; Delta_3 = eps_A.

    Chua's equations with the cubic and the constants A = 10, B = 100 / 7 of Hartley.
    """
    x1, x2, x3 = x = sp.symbols("x1:4", real=True)
    A, B = sp.symbols("A B", positive=True)
    eps_A, eps_B = sp.symbols("eps_A eps_B", real=True)
    t, r = 0.2, 0.2  # ends of the intervals of eps_A, eps_B
    N = (2 * x1**3 - x1) / 7
    dN, ddN = N.diff(x1), N.diff(x1, 2)
    i1, i2 = x2 - N, x1 - x2 + x3
    # y''' = sum_k (1 + eps_A)^k w_k - A (1 + eps_A) eps_B B x2
    w1, w2, w3 = -A * (i2 + B * x2), A**2 * (i1 - dN * i2), A**3 * i1 * (dN**2 - ddN * i1)
    unmatched = abs(w1 + 2 * w2 + 3 * w3) + t * abs(w2 + 3 * w3) + t**2 * abs(w3)
    matched = r * A * B * abs(x2)
    return FlatSystem(
        name="Chua",
        state=tuple(map(str, x)),
        f=(A * i1, i2, -B * x2),
        g=(0, 0, 1),
        h=x1,
        Delta=(eps_A * A * i1, 0, -eps_B * B * x2),
        parameters={"A": 10.0, "B": 100 / 7},
        theta={"eps_A": (-t, t), "eps_B": (-r, r)},
        region={"x1": (-4, 4), "x2": (-4, 4), "x3": (-15, 15)},
        bounds={
            "delta_1": t * unmatched + (1 + t) * matched,
            "delta_3": t,
            "delta_m": t * A**2 * abs(i1 * (1 - A * ddN * i1 + A * dN**2)) + matched,
            "sharp_1": t / (1 - t) * unmatched + matched,
            "sharp_3": t / (1 - t),
        },
        task=Task(
            model_pole=3.0,
            process_pole=10.0,
            theta=(-0.2, 0.15),
            initial_state=(0.5, 0.0, 0.0),
            initial_set={"x1": (-0.5, 0.5), "x2": (-0.2, 0.2), "x3": (-0.5, 0.5)},
            input_limit=100.0,
            horizon=20.0,
            dt=0.005,
        ),
    )
