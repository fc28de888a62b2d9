"""Stirred tank reactor with an exothermic reaction: local, about its unstable operating point."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def cstr() -> FlatSystem:
    """Conversion x1, temperature x2 of the reactor and of the cooling jacket u, time in residence times; y = x1.

    x1' = -x1 + (1 + eps_r) r,   x2' = -x2 + B (1 + eps_B) (1 + eps_r) r - be x2 + be u,
    r = Da (1 - x1) exp(x2 / (1 + x2 / ga)).
    Dimensionless. Uncertain (relative): the rate of the reaction eps_r, its heat eps_B (matched).
    beta = be r_2, r_2 = dr/dx2, positive for x1 < 1 and x2 > -ga; Delta_3 = eps_r.

    The usual dimensionless reactor, Da = 0.072, B = 8, be = 0.3, ga = 20: three steady states for u = 0, the middle one
    (0.447, 2.75) unstable.
    """
    x1, x2 = x = sp.symbols("x1:3", real=True)
    Da, B, be, ga = sp.symbols("Da B be ga", positive=True)
    eps_r, eps_B = sp.symbols("eps_r eps_B", real=True)
    t, h = 0.2, 0.2  # ends of the intervals of eps_r, eps_B
    r = Da * (1 - x1) * sp.exp(x2 / (1 + x2 / ga))
    r_1, r_2 = r.diff(x1), r.diff(x2)
    # y'' = x1 + (1 + eps_r) w1 + (1 + eps_r)^2 (w2 + eps_B heat)
    heat = B * r * r_2
    w1, w2 = -r - r_1 * x1 - (1 + be) * x2 * r_2, r * r_1 + heat
    return FlatSystem(
        name="stirred tank reactor",
        state=tuple(map(str, x)),
        f=(-x1 + r, -(1 + be) * x2 + B * r),
        g=(0, be),
        h=x1,
        Delta=(eps_r * r, B * r * (eps_r + eps_B + eps_r * eps_B)),
        parameters={"Da": 0.072, "B": 8.0, "be": 0.3, "ga": 20.0},
        theta={"eps_r": (-t, t), "eps_B": (-h, h)},
        region={"x1": (0.0, 0.9), "x2": (0.0, 6.0)},
        bounds={
            "delta_1": t * abs(w1 + 2 * w2) + t**2 * abs(w2) + (1 + t) ** 2 * h * heat,
            "delta_3": t,
            "delta_m": t * abs(r * (r_1 - 1) + heat) + (1 + t) * h * heat,
            "sharp_1": t / (1 - t) * abs(w1 + w2) + t * abs(w2) + (1 + t) * h * heat,
            "sharp_3": t / (1 - t),
        },
        task=Task(
            model_pole=2.0,
            process_pole=8.0,
            theta=(-0.2, 0.1),
            initial_state=(0.4, 2.5),
            initial_set={"x1": (0.35, 0.55), "x2": (2.4, 3.1)},
            input_limit=20.0,
            reference_scale=0.1,
            reference_offset=0.45,
            horizon=20.0,
            dt=0.01,
        ),
    )
