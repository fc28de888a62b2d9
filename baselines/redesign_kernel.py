"""The compiled control law of the redesign family: eq. (18) of [1] with a gain rule, a switching law and a model loop."""

from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mfc_gym import kernels
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]
REFERENCE, PROCESS, GIVEN = 0, 1, 2  # where the model starts


class Law(NamedTuple):
    """Constants of the control law for one sampling time."""

    k: Array  # (n,), model loop
    k_tilde: Array  # (n,), process loop
    c: Array  # (n,), P B
    E: Array  # (n, n), transition matrix of the model loop's error over dt
    Phi: Array  # (n, n), transition matrix of the integrator chain over dt
    Psi: Array  # (n,), its response to a unit input held over dt
    hermite: Array  # (n+1, n+1), see `model_loop.hermite_matrix`
    start: Array  # (n,), xi*(0) where `begin` is GIVEN
    begin: int
    margin: float  # factor on Gamma
    width: float  # of the boundary layer
    delta_1: float  # constant bounds that replace the plant's; negative: not given
    delta_3: float
    dt: float  # s
    input_limit: float


TEMPLATE = '''"""Generated: the control law for {name!r}. Do not edit."""

import numpy as np
from numba import njit

from baselines.gains import {gain} as gain
from baselines.model_loop import apply, hermite_coefficients, inner, interpolate
from baselines.switching import clip
from baselines.switching import {switching} as switching
from {nominal} import bounds as nominal_bounds
from {nominal} import coordinates, input_field, lie_terms, nominal_drift

N = {n}
MODEL = slice(0, N)
PREDICTED = N
BEFORE = slice(N + 1, 2 * N + 2)


@njit
def terms(x, z, reference, e_star, law):
    """(alpha, beta, omega_star + v_tilde, Gamma, s) of the continuous-time law; z is xi_n, or xi for matched uncertainty."""
    alpha, beta = lie_terms({arguments})
    bounds = nominal_bounds({arguments})
    if law.delta_1 >= 0.0 or law.delta_3 >= 0.0:
        delta_1 = law.delta_1 if law.delta_1 >= 0.0 else bounds[0]
        delta_3 = law.delta_3 if law.delta_3 >= 0.0 else bounds[1]
        bounds = (delta_1, delta_3, delta_1, delta_1 / (1.0 - delta_3), delta_3 / (1.0 - delta_3))
    omega_star = reference[N] - inner(law.k, e_star)
    v_tilde = 0.0
    s = 0.0
    for i in range(N):
        e = z[i] - reference[i] - e_star[i]
        v_tilde -= law.k_tilde[i] * e
        s += law.c[i] * e
    Gamma = law.margin * gain(alpha, omega_star, v_tilde, bounds)
    return alpha, beta, omega_star + v_tilde, Gamma, s


@njit
def model_tau(x, out):
    """out = tau(x)."""
    {out} = coordinates({arguments})


@njit
def model_rate(x, reference, law, e_star, out):
    """out = f(x*) + g(x*) u*, eq. (12) of [1], with u* of eq. (14) and omega* of eq. (20)."""
    model_tau(x, e_star)
    omega_star = reference[N]
    for i in range(N):
        omega_star -= law.k[i] * (e_star[i] - reference[i])
    alpha, beta = lie_terms({arguments})
    u_star = (omega_star - alpha) / beta
    {out} = nominal_drift({arguments})
    {g} = input_field({arguments})
    for i, g in enumerate(({g})):
        out[i] += g * u_star


@njit
def advance_nonlinear(x, before, after, law):
    """The nonlinear model over one sampling interval, RK4 with {substeps} substeps; x is updated."""
    coefficients, reference = np.empty(N + 1), np.empty(N + 1)
    hermite_coefficients(before, after, law.hermite, law.dt, coefficients)
    xi, stage, start = np.empty(N), np.empty(N), np.empty(N)
    rates = np.empty((4, N))
    h = law.dt / {substeps}
    for m in range({substeps}):
        start[:] = x
        for j, shift in enumerate((0.0, 0.5, 0.5, 1.0)):
            interpolate(before, coefficients, (m + shift) / {substeps}, law.dt, reference)
            for i in range(N):
                stage[i] = start[i] + (shift * h * rates[j - 1, i] if j > 0 else 0.0)
            model_rate(stage, reference, law, xi, rates[j])
        for i in range(N):
            x[i] = start[i] + h / 6.0 * (rates[0, i] + 2.0 * (rates[1, i] + rates[2, i]) + rates[3, i])


@njit
def model_error(x, z, reference, memory, fresh, law, e_star):
    """e_star = xi* - xi_d at this sample, from the memory; the {model} model loop."""
    {model_error}


@njit
def model_advance(reference, memory, law, e_star):
    """Memory of the model loop for the next sample."""
    {model_advance}


@njit
def control(x, xi_n, reference, memory, fresh, law, scratch):
    """u, eq. (18) of [1], saturated; the memory is updated."""
    z, e_star = scratch[0], scratch[1]
    {z_source}
    if fresh:
        memory[PREDICTED] = np.nan
    model_error(x, z, reference, memory, fresh, law, e_star)
    alpha, beta, base, Gamma, s = terms(x, z, reference, e_star, law)
    # next s for v_L = 0: the plant's chain under the held input less the model's exact next state
    a, b = 0.0, 0.0
    for i in range(N):
        after = law.Psi[i] * (base - reference[N])
        for j in range(N):
            after += law.Phi[i, j] * (z[j] - reference[j]) - law.E[i, j] * e_star[j]
        a += law.c[i] * after
        b += law.c[i] * law.Psi[i]
    d = 0.0 if np.isnan(memory[PREDICTED]) else (s - memory[PREDICTED]) / b
    v_L = switching(s, a, b, d, Gamma, law.width)
    u = clip((base + v_L - alpha) / beta, law.input_limit)
    memory[PREDICTED] = a + b * (alpha + beta * u - base)
    model_advance(reference, memory, law, e_star)
    return u


@njit(cache=True, nogil=True)
def control_all(observations, memory, fresh, law):
    """u of each row, shape (N,)."""
    u = np.empty(observations.shape[0])
    scratch = np.empty((2, N))
    for i in range(u.size):
        row = observations[i]
        u[i] = control(row[:N], row[N : 2 * N], row[2 * N :], memory[i], fresh[i], law, scratch)
    return u


@njit(cache=True, nogil=True)
def terms_at(x, z, reference, e_star, law):
    """`terms`, for the exact solution."""
    return terms(x, z, reference, e_star, law)
'''

MODEL_ERROR = {
    "brunovsky": """if fresh:
        for i in range(N):
            if law.begin == 0:
                memory[i] = 0.0
            elif law.begin == 1:
                memory[i] = z[i] - reference[i]
            else:
                memory[i] = law.start[i] - reference[i]
    e_star[:] = memory[MODEL]""",
    "nonlinear": """if not fresh:
        advance_nonlinear(memory[MODEL], memory[BEFORE], reference, law)
    model_tau(memory[MODEL], e_star)
    for i in range(N):
        e_star[i] -= reference[i]""",
    "reference": "e_star[:] = 0.0",
}
MODEL_ADVANCE = {
    "brunovsky": "apply(law.E, e_star, memory[MODEL])",
    "nonlinear": "memory[BEFORE] = reference",
    "reference": "pass",
}
FEEDBACK = {
    "output derivatives": "z[:] = xi_n",
    "state": "model_tau(x, z)",
}
SUBSTEPS = 4  # of the nonlinear model per sampling interval


def memory_size(n: int, model: str) -> int:
    """Numbers of memory per episode: model state, predicted s, and for the nonlinear model the last reference."""
    return 2 * n + 2 if model == "nonlinear" else n + 1


def load(nominal: NominalModel, model: str, feedback: str, gain: str, switching: str) -> ModuleType:
    """The compiled law for this nominal model and these parts."""
    n = nominal.order
    source = TEMPLATE.format(
        name=nominal.name,
        nominal=nominal.kernel.__name__,
        n=n,
        gain=gain,
        switching=switching.replace("-", "_"),
        model=model,
        arguments=", ".join(f"x[{i}]" for i in range(n)),
        out=", ".join(f"out[{i}]" for i in range(n)) + ",",
        g=", ".join(f"g{i + 1}" for i in range(n)) + ",",
        model_error=MODEL_ERROR[model],
        model_advance=MODEL_ADVANCE[model],
        z_source=FEEDBACK[feedback],
        substeps=SUBSTEPS,
    )
    library = kernels.fingerprint(*kernels.files("baselines", "gains", "model_loop", "switching"))
    hashed = kernels.key(source, library)
    return kernels.load(f"mfc_law_{hashed}", lambda: source)
