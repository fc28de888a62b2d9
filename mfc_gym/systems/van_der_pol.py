"""Van der Pol's oscillator."""

import sympy as sp

from mfc_gym.flat_system import FlatSystem
from mfc_gym.task import Task


def van_der_pol() -> FlatSystem:
    """x1' = (1 + eps_1) x2 + eps_s sin x1, x2' = -x1 + mu (1 + eps_mu) (1 - x1^2) x2 + u, y = x1.

    Dimensionless, mu = 1. Uncertain: gain of the first integrator eps_1 (relative), a disturbance eps_s in front of it,
    damping eps_mu (relative, matched). beta = 1; Delta_3 = eps_1.
    """
    x1, x2 = x = sp.symbols("x1:3", real=True)
    mu, eps_1, eps_s, eps_mu = sp.symbols("mu eps_1 eps_s eps_mu", real=True)
    t, d, m = 0.3, 0.3, 0.3  # ends of the intervals of eps_1, eps_s, eps_mu
    damping = mu * (1 - x1**2) * x2
    alpha, s, co = -x1 + damping, sp.sin(x1), sp.cos(x1)
    return FlatSystem(
        name="Van der Pol",
        state=tuple(map(str, x)),
        f=(x2, alpha),
        g=(0, 1),
        h=x1,
        Delta=(eps_1 * x2 + eps_s * s, eps_mu * damping),
        parameters={"mu": 1.0},
        theta={"eps_1": (-t, t), "eps_s": (-d, d), "eps_mu": (-m, m)},
        region={"x1": (-5, 5), "x2": (-15, 15)},
        bounds={  # y'' = (1 + eps_1) (alpha + eps_mu damping) + eps_s co y'
            "delta_1": t * abs(alpha) + (1 + t) * m * abs(damping) + d * abs(co) * ((1 + t) * abs(x2) + d * abs(s)),
            "delta_3": t,
            "delta_m": m * abs(damping),
            "sharp_1": t / (1 - t) * abs(alpha) + m * abs(damping) + d * abs(co) * (abs(x2) + d / (1 - t) * abs(s)),
            "sharp_3": t / (1 - t),
        },
        task=Task(
            model_pole=2.0,
            process_pole=14.0,
            theta=(-0.25, 0.3, 0.2),
            initial_state=(1.0, 0.0),
            initial_set={"x1": (-1.0, 1.0), "x2": (-1.0, 1.0)},
            input_limit=50.0,
            horizon=20.0,
            dt=0.01,
        ),
    )
