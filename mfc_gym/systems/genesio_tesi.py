"""The Genesio-Tesi oscillator, chaotic when left alone."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def genesio_tesi() -> FlatSystem:
    """x1' = (1 + eps_1) x2, x2' = (1 + eps_2) x3, x3' = -c (1 + eps_c) x1 - b x2 - a x3 + x1^2 + u, y = x1.

    Dimensionless. Uncertain (relative): the gains of the integrators eps_1, eps_2, the coefficient eps_c (matched).
    With p = (1 + eps_1)(1 + eps_2): beta = 1; Delta_3 = p - 1, Delta_1 = (p - 1) L_f^3 h - p eps_c c x1.

    Genesio and Tesi's equation with the usual a = 1.2, b = 2.92, c = 6: a b < c, chaotic for u = 0.
    """
    x1, x2, x3 = x = sp.symbols("x1:4", real=True)
    a, b, c = sp.symbols("a b c", positive=True)
    eps_1, eps_2, eps_c = sp.symbols("eps_1 eps_2 eps_c", real=True)
    t, r = 0.25, 0.2  # ends of the intervals of eps_1 and eps_2, of eps_c
    p_min, p_max = (1 - t) ** 2, (1 + t) ** 2
    alpha, matched = -c * x1 - b * x2 - a * x3 + x1**2, r * c * abs(x1)
    return FlatSystem(
        name="Genesio-Tesi",
        state=tuple(map(str, x)),
        f=(x2, x3, alpha),
        g=(0, 0, 1),
        h=x1,
        Delta=(eps_1 * x2, eps_2 * x3, -eps_c * c * x1),
        parameters={"a": 1.2, "b": 2.92, "c": 6.0},
        theta={"eps_1": (-t, t), "eps_2": (-t, t), "eps_c": (-r, r)},
        region={"x1": (-10, 10), "x2": (-15, 15), "x3": (-30, 30)},
        bounds={
            "delta_1": (p_max - 1) * abs(alpha) + p_max * matched,
            "delta_3": p_max - 1,
            "delta_m": matched,
            "sharp_1": (1 / p_min - 1) * abs(alpha) + matched,
            "sharp_3": 1 / p_min - 1,
        },
        task=Task(
            model_pole=2.0,
            process_pole=6.0,
            theta=(0.2, -0.25, 0.1),
            initial_state=(0.5, 0.5, 0.0),
            initial_set={"x1": (-0.5, 0.5), "x2": (0.5, 1.5), "x3": (-0.5, 0.5)},
            input_limit=50.0,
            horizon=20.0,
            dt=0.01,
        ),
    )
