"""Magnetic levitation with voltage input: local, the ball hangs below the magnet and the current flows one way."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def magnetic_levitation() -> FlatSystem:
    """Distance x1 (m) of the ball below the magnet, speed x2 (m/s), current x3 (A), voltage u (V); y = x1.

    x2' = g - k x2 / m - (1 + eps_F) F,   x3' = (-R (1 + eps_R) x3 + L0 a x2 x3 / (a + x1)^2 + u) / L(x1),
    F = L0 a x3^2 / (2 m (a + x1)^2),   L(x1) = L1 + L0 a / (a + x1).
    Uncertain (relative): the force of the magnet eps_F, the resistance eps_R (matched).
    beta = -L0 a x3 / (m (a + x1)^2 L(x1)) vanishes with the current: the region ends before. Delta_3 = eps_F.
    Equilibria x3 = (a + x1) sqrt(2 m g / (L0 a)), 6.264 A at x1 = 5 cm; f(0) is not zero.

    Khalil, Nonlinear Systems, exercise: m = 0.1 kg, k = 0.001 N s/m, a = 0.05 m, L0 = 0.01 H, L1 = 0.02 H, R = 1 ohm.
    """
    x1, x2, x3 = x = sp.symbols("x1:4", real=True)
    g, m, k, a, L0, L1, R = sp.symbols("g m k a L0 L1 R", positive=True)
    eps_F, eps_R = sp.symbols("eps_F eps_R", real=True)
    t, r = 0.2, 0.2  # ends of the intervals of eps_F, eps_R
    L = L1 + L0 * a / (a + x1)
    F = L0 * a * x3**2 / (2 * m * (a + x1) ** 2)
    current = L0 * a * x2 / (L * (a + x1) ** 2) - R / L  # x3' / x3 for u = 0
    unmatched = F * abs(k / m + 2 * x2 / (a + x1) - 2 * current)  # y''' = ... - (1 + eps_F) F'
    matched = 2 * r * R * F / L
    return FlatSystem(
        name="magnetic levitation",
        state=tuple(map(str, x)),
        f=(x2, g - k * x2 / m - F, current * x3),
        g=(0, 0, 1 / L),
        h=x1,
        Delta=(0, -eps_F * F, -eps_R * R * x3 / L),
        parameters={"g": 9.81, "m": 0.1, "k": 0.001, "a": 0.05, "L0": 0.01, "L1": 0.02, "R": 1.0},
        theta={"eps_F": (-t, t), "eps_R": (-r, r)},
        region={"x1": (0.0, 0.15), "x2": (-2, 2), "x3": (1, 15)},
        bounds={
            "delta_1": t * unmatched + (1 + t) * matched,
            "delta_3": t,
            "delta_m": t * F * k / m + matched,
            "sharp_1": t / (1 - t) * unmatched + matched,
            "sharp_3": t / (1 - t),
        },
        task=Task(
            model_pole=15.0,
            process_pole=30.0,
            theta=(-0.15, 0.2),
            initial_state=(0.053, 0.0, 6.4),
            initial_set={"x1": (0.047, 0.053), "x2": (-0.02, 0.02), "x3": (6.1, 6.4)},
            input_limit=15.0,
            reference_scale=0.012,
            reference_offset=0.05,
            horizon=10.0,
            dt=0.002,
        ),
    )
