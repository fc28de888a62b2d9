"""The perturbed integrator chain: the illustrative example of [1], Section 6, for any order n from 2 to 32.

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output time-derivatives
    to compensate unmatched uncertainties.
"""

import sympy as sp

from mfc_gym.flat_system import INPUT_LIMIT, FlatSystem
from mfc_gym.task import Task

LARGEST = 32  # order; generating and compiling its kernels takes half a minute


def perturbed_chain(order: int = 3, rho: float = 0.25) -> FlatSystem:
    """x_i' = (1 + alpha_i) x_(i+1), x_n' = u + abs(x)^2, y = x_1.

    With p = prod(1 + alpha_i): Delta_3 = p - 1 and Delta_1 = p abs(x)^2; `rho` bounds abs(p - 1). While abs(u) <= input_limit,
    a state with x_n > sqrt(input_limit) can no longer be stopped from escaping in finite time: the region ends there. The task's
    poles and input limit serve up to order 6; of higher orders slower poles ask for less input.
    """
    if isinstance(order, bool) or not isinstance(order, int) or not 2 <= order <= LARGEST:
        raise ValueError(f"`order` must be an integer from 2 to {LARGEST}, got {order!r}.")
    if not 0 <= rho < 1:
        raise ValueError(f"`rho` must lie in [0, 1), got {rho}.")
    names = [f"x{i}" for i in range(1, order + 1)]
    x = sp.symbols(names, real=True)
    alpha = sp.symbols([f"alpha{i}" for i in range(1, order)], real=True)
    norm2 = sum(s**2 for s in x)
    return FlatSystem(
        name="perturbed chain",
        state=tuple(names),
        f=(*x[1:], sp.Integer(0)),
        g=(*(0,) * (order - 1), 1),
        h=x[0],
        Delta=(*(a * s for a, s in zip(alpha, x[1:], strict=True)), norm2),
        theta={a.name: (-0.5, 0.5) for a in alpha},
        region={**dict.fromkeys(names, (-10, 10)), names[-1]: (-10, sp.Min(10, sp.sqrt(INPUT_LIMIT)))},
        bounds={
            "delta_1": (1 + rho) * norm2,
            "delta_3": rho,
            "delta_m": norm2,
            "sharp_1": norm2,
            "sharp_3": rho / (1 - rho),
        },
        task=Task(
            theta=(0.5, -0.5, *(0.0,) * (order - 3))[: order - 1] if order > 2 else (0.25,),
            initial_state=(1.0, *(0.0,) * (order - 1)),
            initial_set={names[0]: (-1.0, 1.0), **dict.fromkeys(names[1:], (-0.5, 0.5))},
        ),
    )
