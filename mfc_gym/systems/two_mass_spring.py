"""Two masses and a spring: the benchmark problem of the American Control Conference."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def two_mass_spring() -> FlatSystem:
    """Positions x1, x2 (m) and speeds x3, x4 (m/s) of the driven and the far mass, force u (N) on the first; y = x2.

    m1 x3' = -k0 (1 + eps_k) (x1 - x2) + u,   m2 x4' = k0 (1 + eps_k) (x1 - x2).
    Uncertain: the stiffness, 0.5 <= k0 (1 + eps_k) <= 2 N/m. beta = k0 / (m1 m2); Delta_3 = eps_k. The nominal value is
    the middle, k0 = 1.25 N/m, so that abs(Delta_3) <= 0.6: with k0 = 1 N/m the set would reach Delta_3 = 1.

    Wie and Bernstein, J. Guidance, Control, and Dynamics, doi 10.2514/3.20949: m1 = m2 = 1 kg.
    """
    x1, x2, x3, x4 = x = sp.symbols("x1:5", real=True)
    k0, m1, m2, eps_k = sp.symbols("k0 m1 m2 eps_k", real=True)
    k = 0.6  # end of the interval of eps_k
    force, relative = k0 * (x1 - x2), k0 * (1 / m1 + 1 / m2)
    alpha = abs(relative * force) / m2  # y'''' = (1 + eps_k) u beta - (1 + eps_k)^2 alpha sgn(x1 - x2)
    return FlatSystem(
        name="two masses and a spring",
        state=tuple(map(str, x)),
        f=(x3, x4, -force / m1, force / m2),
        g=(0, 0, 1 / m1, 0),
        h=x2,
        Delta=(0, 0, -eps_k * force / m1, eps_k * force / m2),
        parameters={"k0": 1.25, "m1": 1.0, "m2": 1.0},
        theta={"eps_k": (-k, k)},
        region=dict.fromkeys(map(str, x), (-10, 10)),
        bounds={
            "delta_1": (2 * k + k**2) * alpha,
            "delta_3": k,
            "delta_m": k * alpha,
            "sharp_1": (1 / (1 - k) - (1 - k)) * alpha,
            "sharp_3": k / (1 - k),
        },
        task=Task(
            model_pole=1.5,
            process_pole=4.0,
            theta=(-0.4,),
            initial_state=(0.2, 0.2, 0.3, 0.3),
            initial_set={"x1": (-0.2, 0.2), "x2": (-0.2, 0.2), "x3": (0.3, 0.7), "x4": (0.3, 0.7)},
            input_limit=20.0,
            reference_rate=0.5,
            horizon=30.0,
            dt=0.01,
        ),
    )
