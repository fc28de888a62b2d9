"""The compiled continuous-time closed loop: true plant, reference and redesign law in one function of (t, q).

q = (x, e_star). This is the observer's side: it knows the truth, and no controller imports it.
"""

from types import ModuleType

from baselines.redesign import LyapunovRedesign
from baselines.redesign_kernel import Layout
from mfc_gym import kernels
from mfc_gym.plant import Plant
from mfc_gym.references import Reference

TEMPLATE = '''"""Generated: the continuous-time closed loop of {name!r}. Do not edit."""

import numpy as np
from numba import njit

from baselines.model_loop import inner
from baselines.switching import clip
from mfc_gym.references import {reference} as reference
from {plant} import coordinate_drift, coordinate_input, coordinates, drift, input_field, output_derivatives, output_rate
from {law} import terms

N = {n}


@njit
def evaluate(t, q, mode, theta, parameters, law, out):
    """out = [q' (2n), u, s, push of mode +1, of mode -1, Gamma, xi_n (n), xi (n), y_d ... y_d^(n) (n+1)]."""
    e_star = q[N:]
    xi_n, xi, yd = out[2 * N + 5 : 3 * N + 5], out[3 * N + 5 : 4 * N + 5], out[4 * N + 5 :]
    reference(t, parameters, yd)
    {xi_n} = output_derivatives({arguments})
    {xi} = coordinates({arguments})
    z, k, c, input_limit = {z}, law[{k} : {k} + N], law[{c} : {c} + N], law[{input_limit}]
    alpha, beta, base, Gamma, s = terms({scalars}, law)
    # rate of s = c' (z - xi_d - e_star), without and per input
    without, per_input = {rates}
    for i in range(N):
        after = e_star[i + 1] if i + 1 < N else -inner(k, e_star)
        out[N + i] = after
        without -= c[i] * (yd[i + 1] + after)
    plus = clip((base - alpha - Gamma) / beta, input_limit)
    minus = clip((base - alpha + Gamma) / beta, input_limit)
    u = plus if mode > 0 else minus if mode < 0 else -without / per_input
    size = 1.0 + abs(without) + abs(per_input) * max(abs(plus), abs(minus))
    {free} = drift({arguments})
    {per} = input_field({arguments})
    for i, (a, b) in enumerate(zip(({free}), ({per}))):
        out[i] = a + b * u
    out[2 * N] = u
    out[2 * N + 1] = s
    out[2 * N + 2] = (without + per_input * plus) / size
    out[2 * N + 3] = (without + per_input * minus) / size
    out[2 * N + 4] = Gamma


@njit(cache=True, nogil=True)
def evaluate_one(t, q, mode, theta, parameters, law):
    """`evaluate` at one point, shape (5n + 6,)."""
    out = np.empty(5 * N + 6)
    evaluate(t, q, mode, theta, parameters, law, out)
    return out


@njit(cache=True, nogil=True)
def evaluate_all(times, states, modes, theta, parameters, law):
    """`evaluate` at many points, shape (len(times), 5n + 6)."""
    out = np.empty((times.size, 5 * N + 6))
    for i in range(times.size):
        evaluate(times[i], states[i], modes[i], theta, parameters, law, out[i])
    return out
'''

Z = {"output derivatives": "xi_n", "state": "xi"}


def load(plant: Plant, reference: Reference, controller: LyapunovRedesign) -> ModuleType:
    """The compiled closed loop of these three."""
    n, p = plant.order, len(plant.theta)
    layout = Layout(n)
    arguments = ", ".join([*(f"q[{i}]" for i in range(n)), *(f"theta[{i}]" for i in range(p))])
    if controller.feedback == "state":
        rates = (
            f"0.0, 0.0\n    for weight, a, b in zip(c, coordinate_drift({arguments}), coordinate_input({arguments})):\n"
            "        without += weight * a\n        per_input += weight * b"
        )
    else:
        rates = (
            "0.0, 0.0\n    for i in range(N - 1):\n        without += c[i] * xi_n[i + 1]\n"
            f"    a, b = output_rate({arguments})\n    without += c[N - 1] * a\n    per_input += c[N - 1] * b"
        )
    source = TEMPLATE.format(
        name=plant.name,
        plant=plant.kernel.__name__,
        law=controller.kernel.__name__,
        reference=reference.derivatives.__name__,
        n=n,
        arguments=arguments,
        xi_n=", ".join(f"xi_n[{i}]" for i in range(n)),
        xi=", ".join(f"xi[{i}]" for i in range(n)),
        z=Z[controller.feedback],
        k=layout.vector("k"),
        c=layout.vector("c"),
        input_limit=layout.scalar("input_limit"),
        scalars=", ".join(
            [
                *(f"q[{i}]" for i in range(n)),
                *(f"z[{i}]" for i in range(n)),
                *(f"yd[{i}]" for i in range(n + 1)),
                *(f"q[{n + i}]" for i in range(n)),
            ]
        ),
        rates=rates,
        free=", ".join(f"a{i}" for i in range(n)) + ",",
        per=", ".join(f"b{i}" for i in range(n)) + ",",
    )
    hashed = kernels.key(
        source,
        kernels.fingerprint(
            *kernels.files("mfc_gym", "references"), *kernels.files("baselines", "model_loop", "switching")
        ),
    )
    return kernels.load(f"mfc_loop_{hashed}", lambda: source)
