"""Single-link arm with a flexible joint."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def flexible_joint() -> FlatSystem:
    """Link x1 (rad), x2 (rad/s) on a spring behind a motor x3 (rad), x4 (rad/s), motor input u (V); y = x1.

    x2' = -a (1 + eps_g) sin x1 - b (1 + eps_k) (x1 - x3) - nu x2,   x4' = c (1 + eps_k) (x1 - x3) - e x4 + d u.
    Uncertain: gravity eps_g and stiffness of the joint eps_k (relative), friction of the link nu (1/s, nominally none).
    beta = b d; Delta_3 = eps_k. With eps_k = 0 Delta is orthogonal to g, and yet it enters phi_m: see `delta_m`.

    Constants a, b, c (1/s^2), d (1/(V s^2)), e (1/s) of the observer benchmark of Raghavan and Hedrick, also in Ibrir
    et al., Int. J. Control 78:385 (2005).
    """
    x1, x2, x3, x4 = x = sp.symbols("x1:5", real=True)
    a, b, c, d, e = sp.symbols("a b c d e", positive=True)
    eps_g, eps_k, nu = sp.symbols("eps_g eps_k nu", real=True)
    g, k, f = 0.3, 0.3, 0.5  # ends of the intervals of eps_g, eps_k, nu
    s, co, q = sp.sin(x1), sp.cos(x1), x1 - x3
    # y^(4) = (1 + eps_k)^2 spring + (1 + eps_k) (linear + terms <= coupled) + terms <= rest
    spring, gravity = b * (b + c) * q, a * b * (co * q + s)
    linear = gravity - b * e * x4
    coupled = g * abs(gravity) + f * b * (abs(2 * x2 - x4) + f * abs(q))
    rest = (
        g * abs(a * s * x2**2 + 2 * a**2 * s * co)
        + g**2 * a**2 * abs(s * co)
        + f * (1 + g) * a * (2 * abs(co * x2) + f * abs(s))
        + f**3 * abs(x2)
    )
    return FlatSystem(
        name="flexible joint",
        state=tuple(map(str, x)),
        f=(x2, -a * s - b * q, x4, c * q - e * x4),
        g=(0, 0, 0, d),
        h=x1,
        Delta=(0, -eps_g * a * s - eps_k * b * q - nu * x2, 0, eps_k * c * q),
        parameters={"a": 3.33, "b": 19.5, "c": 48.6, "d": 21.6, "e": 1.25},
        theta={"eps_g": (-g, g), "eps_k": (-k, k), "nu": (0.0, f)},
        region={"x1": (-4, 4), "x2": (-10, 10), "x3": (-5, 5), "x4": (-30, 30)},
        bounds={
            "delta_1": k * (abs(2 * spring + linear) + k * abs(spring)) + (1 + k) * coupled + rest,
            "delta_3": k,
            "delta_m": (a * co + b) * (g * a * abs(s) + f * abs(x2)) + k * b * (a * co + b + c) * abs(q),
            "sharp_1": k / (1 - k) * abs(spring + linear) + k * abs(spring) + coupled + rest / (1 - k),
            "sharp_3": k / (1 - k),
        },
        task=Task(
            model_pole=3.0,
            process_pole=10.0,
            theta=(0.2, -0.3, 0.2),
            initial_state=(0.3, 0.0, 0.3, 0.0),
            initial_set=dict.fromkeys(map(str, x), (-0.3, 0.3)),
            input_limit=10.0,
            reference_scale=0.5,
            horizon=20.0,
            dt=0.005,
        ),
    )
