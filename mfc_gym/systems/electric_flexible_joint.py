"""Single-link arm with a flexible joint and an electric drive."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def electric_flexible_joint() -> FlatSystem:
    """Link x1 (rad), x2 (rad/s), spring, motor x3 (rad), x4 (rad/s) with current x5 (A), voltage u (V); y = x1.

    x2' = -a (1 + eps_g) sin x1 - b (1 + eps_k) (x1 - x3),
    x4' = c (1 + eps_k) (x1 - x3) - e x4 + d (1 + eps_d) x5,   x5' = (-R x5 - K x4 + u) / L.
    Uncertain (relative): gravity eps_g, stiffness of the joint eps_k, torque constant of the motor eps_d.
    beta = b d / L; Delta_3 = (1 + eps_k) (1 + eps_d) - 1.

    The arm of `flexible_joint` behind the armature circuit (R, L) of `motor_pendulum`, put together for this library;
    the voltage constant K = 0.08 V s is a choice, no literature value.
    """
    x1, x2, x3, x4, x5 = x = sp.symbols("x1:6", real=True)
    a, b, c, d, e, L, R, K = sp.symbols("a b c d e L R K", positive=True)
    eps_g, eps_k, eps_d = sp.symbols("eps_g eps_k eps_d", real=True)
    g, k, t = 0.2, 0.2, 0.2  # ends of the intervals of eps_g, eps_k, eps_d
    s, co, q, dq = sp.sin(x1), sp.cos(x1), x1 - x3, x2 - x4
    # the terms of y^(5) that go with (1 + eps_g), its square, (1 + eps_g)(1 + eps_k), ...
    y_g = a * co * x2**3
    y_gg = a**2 * x2 * (co**2 - 3 * s**2)
    y_gk = a * b * (co * (x2 + dq) - 3 * s * x2 * q)
    y_k = b * e**2 * x4
    y_kk = b * ((b + c) * dq - e * c * q)
    y_kd = -b * d * (e * x5 + (R * x5 + K * x4) / L)
    r_kd = 1 / ((1 - k) * (1 - t)) - 1
    rest = (
        k / (1 - k) * abs(y_gk + y_k + y_kk)
        + g / (1 - k) * (abs(y_g + 2 * y_gg) + g * abs(y_gg))
        + g * abs(y_gk)
        + k * abs(y_kk)
    )
    return FlatSystem(
        name="electrically driven flexible joint",
        state=tuple(map(str, x)),
        f=(x2, -a * s - b * q, x4, c * q - e * x4 + d * x5, -(R * x5 + K * x4) / L),
        g=(0, 0, 0, 0, 1 / L),
        h=x1,
        Delta=(0, -eps_g * a * s - eps_k * b * q, 0, eps_k * c * q + eps_d * d * x5, 0),
        parameters={"a": 3.33, "b": 19.5, "c": 48.6, "d": 21.6, "e": 1.25, "L": 0.025, "R": 5.0, "K": 0.08},
        theta={"eps_g": (-g, g), "eps_k": (-k, k), "eps_d": (-t, t)},
        region={"x1": (-4, 4), "x2": (-10, 10), "x3": (-5, 5), "x4": (-30, 30), "x5": (-15, 15)},
        bounds={
            "delta_1": (
                g * abs(y_g + 2 * y_gg + y_gk)
                + k * abs(y_gk + y_k + 2 * y_kk + y_kd)
                + t * abs(y_kd)
                + g**2 * abs(y_gg)
                + g * k * abs(y_gk)
                + k**2 * abs(y_kk)
                + k * t * abs(y_kd)
            ),
            "delta_3": (1 + k) * (1 + t) - 1,
            "delta_m": (
                2 * g * a**2 * s**2 * abs(x2) + k * b * abs((2 * a * s * x2 + e * c) * q) + t * b * e * d * abs(x5)
            ),
            "sharp_1": r_kd * abs(y_kd) + rest / (1 - t),
            "sharp_3": r_kd,
        },
        task=Task(
            model_pole=3.0,
            process_pole=8.0,
            theta=(0.15, -0.2, 0.1),
            initial_state=(0.3, 0.0, 0.3, 0.0, 0.0),
            initial_set=dict.fromkeys(map(str, x), (-0.3, 0.3)),
            input_limit=20.0,
            reference_scale=0.5,
            horizon=20.0,
            dt=0.005,
        ),
    )
