"""Direct-current motor that turns a pendulum."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def motor_pendulum() -> FlatSystem:
    """Angle x1 (rad), speed x2 (rad/s), armature current x3 (A), voltage u (V); y = x1.

    x2' = (1 + eps_J) (x3 - D x2 - N (1 + eps_N) sin x1) / M,   x3' = (-R (1 + eps_R) x3 - K x2 + u) / L.
    Uncertain (relative): reciprocal of the inertia eps_J, load eps_N, resistance of the armature eps_R (matched).
    beta = 1 / (L M); Delta_3 = eps_J.

    Model after Dawson, Carroll and Schneider, IEEE Trans. Control Systems Technology (1994); constants as found in
    public implementations: M = 0.0642 A s^2, N = 2.28393 A, D = 0.018056 A s, L = 25 mH, R = 5 ohm, K = 0.9 V s.
    """
    x1, x2, x3 = x = sp.symbols("x1:4", real=True)
    M, N, D, L, R, K = sp.symbols("M N D L R K", positive=True)
    eps_J, eps_N, eps_R = sp.symbols("eps_J eps_N eps_R", real=True)
    j, n, r = 0.3, 0.3, 0.2  # ends of the intervals of eps_J, eps_N, eps_R
    s, co = sp.sin(x1), sp.cos(x1)
    torque = x3 - D * x2 - N * s
    current = -(R * x3 + K * x2) / L
    # y''' = (1 + eps_J) / M (moment + terms <= rest)
    moment = current - N * co * x2 - D * torque / M
    rest = r * R * abs(x3) / L + n * N * abs(co * x2 - D * s / M) + j * D * (abs(torque) + n * N * abs(s)) / M
    return FlatSystem(
        name="motor with pendulum",
        state=tuple(map(str, x)),
        f=(x2, torque / M, current),
        g=(0, 0, 1 / L),
        h=x1,
        Delta=(0, (eps_J * torque - (1 + eps_J) * eps_N * N * s) / M, -eps_R * R * x3 / L),
        parameters={"M": 0.0642, "N": 2.28393, "D": 0.018056, "L": 0.025, "R": 5.0, "K": 0.9},
        theta={"eps_J": (-j, j), "eps_N": (-n, n), "eps_R": (-r, r)},
        region={"x1": (-4, 4), "x2": (-20, 20), "x3": (-20, 20)},
        bounds={
            "delta_1": (j * abs(moment) + (1 + j) * rest) / M,
            "delta_3": j,
            "delta_m": (r * R * abs(x3) / L + D / M * (j * abs(torque) + (1 + j) * n * N * abs(s))) / M,
            "sharp_1": (j / (1 - j) * abs(moment) + rest) / M,
            "sharp_3": j / (1 - j),
        },
        task=Task(
            model_pole=5.0,
            process_pole=20.0,
            theta=(-0.25, 0.3, 0.1),
            initial_state=(0.5, 0.0, 0.0),
            initial_set={"x1": (-0.5, 0.5), "x2": (-1.0, 1.0), "x3": (-1.0, 1.0)},
            input_limit=60.0,
            reference_rate=1.5,
            horizon=10.0,
            dt=0.002,
        ),
    )
