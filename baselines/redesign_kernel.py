"""The compiled control law of the redesign family: eq. (18) of [1] with a gain rule, a switching law and a model loop.

All constants of a law travel in one array, read by the slots of `Layout`; loops over the order are written out, so that a
control step costs tens of nanoseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from baselines.switching import SWITCHINGS
from mfc_gym import kernels
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]
REFERENCE, PROCESS, GIVEN = 0, 1, 2  # where the model starts
SCALARS = ("b", "begin", "margin", "width", "delta_1", "delta_3", "input_limit", "dt", "rate", "keep")
SUBSTEPS = 4  # of the nonlinear model per sampling interval


@dataclass(frozen=True)
class Layout:
    """Slots of the law's constants for order n: vectors of length n, then matrices, then scalars."""

    n: int

    @property
    def vectors(self) -> tuple[str, ...]:
        """Model gains k, process gains k_tilde, c = P B, c' E, c' Phi, and xi*(0) where it is given."""
        return ("k", "k_tilde", "c", "cE", "cPhi", "start")

    def vector(self, name: str) -> int:
        return self.vectors.index(name) * self.n

    @property
    def E(self) -> int:
        """Transition matrix of the model loop's error over dt, row by row."""
        return len(self.vectors) * self.n

    @property
    def hermite(self) -> int:
        """See `model_loop.hermite_matrix`."""
        return self.E + self.n**2

    def scalar(self, name: str) -> int:
        return self.hermite + (self.n + 1) ** 2 + SCALARS.index(name)

    def pack(self, values: dict[str, Array | float]) -> Array:
        """The array of constants."""
        parts = [values[name] for name in (*self.vectors, "E", "hermite", *SCALARS)]
        return np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in parts])


TEMPLATE = '''"""Generated: the control law for {name!r}. Do not edit."""

import numpy as np
from numba import njit

from baselines.gains import {gain} as gain
from baselines.model_loop import hermite_coefficients, interpolate
from baselines.switching import best_rate, clip
from baselines.switching import {switching} as switching
from {nominal} import bounds as nominal_bounds
from {nominal} import coordinates, input_field, lie_terms, nominal_drift, spread

N = {n}
PREDICTED, ESTIMATE, LAST_BASE, LAST_GAMMA = N, N + 1, N + 2, N + 3
BEFORE = slice(N + 4, 2 * N + 5)


@njit
def terms({x}, {z}, {yd}, {e_star}, law):
    """(alpha, beta, omega_star + v_tilde, Gamma, s) of the continuous-time law; z is xi_n, or xi for matched uncertainty."""
    alpha, beta = lie_terms({x})
    bounds = nominal_bounds({x})
    if law[{delta_1}] >= 0.0 or law[{delta_3}] >= 0.0:
        delta_1 = law[{delta_1}] if law[{delta_1}] >= 0.0 else bounds[0]
        delta_3 = law[{delta_3}] if law[{delta_3}] >= 0.0 else bounds[1]
        delta_m = law[{delta_1}] if law[{delta_1}] >= 0.0 else bounds[2]
        bounds = (delta_1, delta_3, delta_m, delta_1 / (1.0 - delta_3), delta_3 / (1.0 - delta_3))
    {e} = {error}
    omega_star = {yd_n} - ({k_e_star})
    v_tilde = -({k_tilde_e})
    Gamma = law[{margin}] * gain(alpha, omega_star, v_tilde, bounds)
    return alpha, beta, omega_star + v_tilde, Gamma, {c_e}


@njit
def consistent(xi_n, xi, spread):
    """xi_n as measured, where the bounds say that it may be, given the state."""
    {xi_n} = xi_n
    {xs} = xi
    {d} = spread
    return {limited}


@njit
def nonlinear_rate(x, reference, law, out):
    """out = f(x*) + g(x*) u*, eq. (12) of [1], with u* of eq. (14) and omega* of eq. (20)."""
    {x} = {x_of_x}
    {z} = coordinates({x})
    {yd} = {yd_of_reference}
    {e} = {z_minus_yd}
    alpha, beta = lie_terms({x})
    u_star = ({yd_n} - ({k_e}) - alpha) / beta
    {out} = nominal_drift({x})
    for i, g in enumerate(input_field({x})):
        out[i] += g * u_star


@njit
def nonlinear_advance(x, before, after, law):
    """The nonlinear model over one sampling interval, RK4 with {substeps} substeps; x is updated."""
    dt = law[{dt}]
    coefficients, reference = np.empty(N + 1), np.empty(N + 1)
    hermite_coefficients(before, after, law[{hermite}:{hermite_end}].reshape((N + 1, N + 1)), dt, coefficients)
    stage, start, rates = np.empty(N), np.empty(N), np.empty((4, N))
    h = dt / {substeps}
    for m in range({substeps}):
        start[:] = x
        for j, shift in enumerate((0.0, 0.5, 0.5, 1.0)):
            interpolate(before, coefficients, (m + shift) / {substeps}, dt, reference)
            for i in range(N):
                stage[i] = start[i] + (shift * h * rates[j - 1, i] if j > 0 else 0.0)
            nonlinear_rate(stage, reference, law, rates[j])
        for i in range(N):
            x[i] = start[i] + h / 6.0 * (rates[0, i] + 2.0 * (rates[1, i] + rates[2, i]) + rates[3, i])


@njit
def control(observation, memory, fresh, law):
    """u, eq. (18) of [1], saturated; the memory is updated."""
    {x} = {x_of_observation}
    {yd} = {yd_of_observation}
    {z} = {measured}
    if fresh:
        memory[PREDICTED], memory[ESTIMATE] = np.nan, 0.0
    {model_error}
    alpha, beta, base, Gamma, s = terms({x}, {z}, {yd}, {e_star}, law)
    {extrapolation}
    # next s for v_L = 0: the plant's chain under the held input less the model's exact next state
    b = law[{b}]
    a = {c_phi_z_minus_yd} - ({c_E_e_star}) + b * (base - {yd_n})
    if not np.isnan(memory[PREDICTED]):
        seen = (s - memory[PREDICTED]) / b
        delta_3 = law[{delta_3}] if law[{delta_3}] >= 0.0 else nominal_bounds({x})[1]
        rate = law[{rate}] if law[{rate}] >= 0.0 else min(best_rate(delta_3), 1.0 - law[{keep}])
        memory[ESTIMATE] = clip(memory[ESTIMATE] + rate * (seen - memory[ESTIMATE]), Gamma)
    v_L = switching(s, a, b, memory[ESTIMATE], Gamma, law[{keep}], law[{width}])
    u = clip((base + v_L - alpha) / beta, law[{input_limit}])
    memory[PREDICTED] = a + b * (alpha + beta * u - base)
    {model_advance}
    return u


@njit(cache=True, nogil=True)
def control_all(observations, memory, fresh, law):
    """u of each row, shape (N,)."""
    u = np.empty(observations.shape[0])
    for i in range(u.size):
        u[i] = control(observations[i], memory[i], fresh[i], law)
    return u
'''

# to the middle of the interval: what is held is then the mean of what changes, to second order
EXTRAPOLATION = """base_now, Gamma_now = base, Gamma
    if not np.isnan(memory[PREDICTED]):
        base += 0.5 * (base - memory[LAST_BASE])
        Gamma = max(Gamma + 0.5 * (Gamma - memory[LAST_GAMMA]), 0.0)
    memory[LAST_BASE], memory[LAST_GAMMA] = base_now, Gamma_now"""

MODEL_ERROR = {
    "brunovsky": """if fresh:
        if law[{begin}] == {REFERENCE}:
            {e_star} = {zeros}
        elif law[{begin}] == {PROCESS}:
            {e_star} = {z_minus_yd}
        else:
            {e_star} = {start_minus_yd}
    else:
        {e_star} = {memory}""",
    "nonlinear": """if not fresh:
        nonlinear_advance(memory[:N], memory[BEFORE], observation[2 * N :], law)
    {xi_star} = coordinates({memory})
    {e_star} = {xi_star_minus_yd}""",
    "reference": "{e_star} = {zeros}",
}
MODEL_ADVANCE = {
    "brunovsky": "{memory} = {E_e_star}",
    "nonlinear": "memory[BEFORE] = observation[2 * N :]",
    "reference": "pass",
}
FEEDBACK = {
    "output derivatives": "{xi_n_of_observation}",
    "state": "coordinates({x})",
    "consistent output derivatives": "consistent(({xi_n_of_observation}), coordinates({x}), spread({x}))",
}


def memory_size(n: int, model: str) -> int:
    """Numbers of memory per episode: model state, predicted s, estimate, last base and Gamma; last reference if nonlinear."""
    return 2 * n + 5 if model == "nonlinear" else n + 4


def estimates(nominal: NominalModel) -> bool:
    """Whether xi_n is an estimate, which the state, known exactly, may correct."""
    return nominal.derivatives != "exact" and nominal.state_noise == 0.0


def _tuple(entries: Sequence[str]) -> str:
    return ", ".join(entries) + ","


def load(nominal: NominalModel, model: str, feedback: str, gain: str, switching: str) -> ModuleType:
    """The compiled law for this nominal model and these parts."""
    n = nominal.order
    layout = Layout(n)
    if feedback == "output derivatives" and estimates(nominal):
        feedback = f"consistent {feedback}"

    def symbols(letter: str, count: int = n) -> list[str]:
        return [f"{letter}{i + 1}" for i in range(count)]

    def dot(offset: int, names: Sequence[str]) -> str:
        return " + ".join(f"law[{offset + i}] * {name}" for i, name in enumerate(names))

    x, z, e, e_star, xi_star = (symbols(letter) for letter in ("x", "z", "e", "es", "xs"))
    yd = [f"yd{i}" for i in range(n + 1)]

    def minus_yd(names: Sequence[str]) -> list[str]:
        return [f"{a} - {b}" for a, b in zip(names, yd, strict=False)]

    words = {
        "x": ", ".join(x),
        "z": ", ".join(z),
        "e": _tuple(e),
        "e_star": ", ".join(e_star),
        "xi_star": _tuple(xi_star),
        "xi_n": _tuple(symbols("m")),
        "xs": _tuple(symbols("xs")),
        "d": _tuple(symbols("d")),
        "limited": _tuple([f"min(max(m{i}, xs{i} - d{i}), xs{i} + d{i})" for i in range(1, n + 1)]),
        "yd": ", ".join(yd),
        "yd_n": yd[n],
        "error": _tuple([f"{a} - {b} - {c}" for a, b, c in zip(z, yd, e_star, strict=False)]),
        "z_minus_yd": _tuple(minus_yd(z)),
        "xi_star_minus_yd": _tuple(minus_yd(xi_star)),
        "start_minus_yd": _tuple(minus_yd([f"law[{layout.vector('start') + i}]" for i in range(n)])),
        "zeros": _tuple(["0.0"] * n),
        "memory": ", ".join(f"memory[{i}]" for i in range(n)),
        "out": ", ".join(f"out[{i}]" for i in range(n)),
        "x_of_x": ", ".join(f"x[{i}]" for i in range(n)),
        "yd_of_reference": ", ".join(f"reference[{i}]" for i in range(n + 1)),
        "x_of_observation": ", ".join(f"observation[{i}]" for i in range(n)),
        "xi_n_of_observation": ", ".join(f"observation[{n + i}]" for i in range(n)),
        "yd_of_observation": ", ".join(f"observation[{2 * n + i}]" for i in range(n + 1)),
        "k_e_star": dot(layout.vector("k"), e_star),
        "k_e": dot(layout.vector("k"), e),
        "k_tilde_e": dot(layout.vector("k_tilde"), e),
        "c_e": dot(layout.vector("c"), e),
        "c_phi_z_minus_yd": dot(layout.vector("cPhi"), [f"({pair})" for pair in minus_yd(z)]),
        "c_E_e_star": dot(layout.vector("cE"), e_star),
        "E_e_star": _tuple([dot(layout.E + n * i, e_star) for i in range(n)]),
        "REFERENCE": f"{REFERENCE}.0",
        "PROCESS": f"{PROCESS}.0",
        **{name: str(layout.scalar(name)) for name in SCALARS},
    }
    source = TEMPLATE.format(
        **words,
        name=nominal.name,
        nominal=nominal.kernel.__name__,
        n=n,
        gain=gain,
        switching=switching.replace("-", "_"),
        substeps=SUBSTEPS,
        hermite=layout.hermite,
        hermite_end=layout.hermite + (n + 1) ** 2,
        measured=FEEDBACK[feedback].format(**words),
        extrapolation=EXTRAPOLATION if SWITCHINGS[switching].averages else "",
        model_error=MODEL_ERROR[model].format(**words),
        model_advance=MODEL_ADVANCE[model].format(**words),
    )
    library = kernels.fingerprint(*kernels.files("baselines", "gains", "model_loop", "switching"))
    return kernels.load(f"mfc_law_{kernels.key(source, library)}", lambda: source)
