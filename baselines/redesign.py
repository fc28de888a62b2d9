"""The redesign family: model-following control with Lyapunov redesign on output derivatives, and what [1] compares it with.

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output time-derivatives
    to compensate unmatched uncertainties.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from baselines import lyapunov, redesign_kernel
from baselines.controller import Controller
from baselines.gains import GAINS
from baselines.model_loop import hermite_matrix
from baselines.switching import SWITCHINGS
from mfc_gym import observation as layout
from mfc_gym.checks import one_of, positive, vector
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]
MODELS = ("brunovsky", "nonlinear", "reference")
FEEDBACKS = ("output derivatives", "state")
MODEL_POLE = {"paper": 0.5, "surface": 1.0}  # of the model loop by design, unit of the task's model pole
STARTS = {"reference": redesign_kernel.REFERENCE, "process": redesign_kernel.PROCESS}


@dataclass(frozen=True, eq=False)
class LyapunovRedesign(Controller):
    """Control law u, eq. (18) of [1], composed of a model loop, a gain rule and a switching law."""

    name: str
    nominal: NominalModel
    k: Array  # (n,), model loop
    k_tilde: Array  # (n,), process loop
    P: Array  # (n, n), V = e' P e
    gain: str
    switching: str
    model: str = "brunovsky"  # or "nonlinear", "reference"
    feedback: str = "output derivatives"  # or "state": xi in place of xi_n
    initial_model_state: str | tuple[float, ...] = "process"  # xi*(0), or where to start: "process", "reference"
    margin: float = 1.0  # factor on the gain rule
    width: float = 0.1  # of the boundary layer, unit of w / 2
    rate: float | None = None  # of the disturbance estimate, in (0, 1]; None: `switching.best_rate` of delta_3
    reach_time: float = 0.0  # s, time constant with which the implicit laws bring w to zero; 0: in one step
    delta_1: float | None = None  # constant bounds in place of the plant's
    delta_3: float | None = None

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]
        measured = ("state",) if self.feedback == "state" else ("state", "output derivatives")
        return (*measured, "nominal model", "bounds")

    @property
    def memory_size(self) -> int:
        return redesign_kernel.memory_size(self.nominal.order, self.model)

    @cached_property
    def kernel(self) -> ModuleType:
        return redesign_kernel.load(self.nominal, self.model, self.feedback, self.gain, self.switching)

    @cached_property
    def law(self) -> Array:
        """The constants of the compiled law, see `redesign_kernel.Layout`."""
        n, dt = self.nominal.order, self.nominal.dt
        A, B = lyapunov.brunovsky(n)
        held = expm(np.block([[A, B[:, None]], [np.zeros((1, n + 1))]]) * dt)
        Phi, Psi, E, c = held[:n, :n], held[:n, n], expm(lyapunov.closed_loop(self.k) * dt), lyapunov.surface(self.P)
        given = not isinstance(self.initial_model_state, str)
        return redesign_kernel.Layout(n).pack(
            {
                "k": self.k,
                "k_tilde": self.k_tilde,
                "c": c,
                "cE": c @ E,
                "cPhi": c @ Phi,
                "start": np.array(self.initial_model_state if given else np.zeros(n), dtype=float),
                "E": E,
                "hermite": hermite_matrix(n),
                "b": c @ Psi,
                "begin": redesign_kernel.GIVEN if given else STARTS[str(self.initial_model_state)],
                "margin": self.margin,
                "width": self.width,
                "delta_1": -1.0 if self.delta_1 is None else self.delta_1,
                "delta_3": -1.0 if self.delta_3 is None else self.delta_3,
                "input_limit": self.nominal.input_limit,
                "dt": dt,
                "keep": self.reach_time / (self.reach_time + dt),
                "rate": -1.0 if self.rate is None else self.rate,
            }
        )

    def control(self, observations: Array, memory: Array, fresh: NDArray[np.bool_]) -> Array:
        if fresh.any():
            memory[fresh] = self.first_memory(observations[fresh])
        u: Array = self.kernel.control_all(observations, memory, fresh, self.law)
        return u

    def measured(self, observation: Array) -> Array:
        """z: xi_n, or xi = tau(x) for the law that knows matched uncertainty only; shape (..., n)."""
        if self.feedback == "state":
            return self.nominal.tau(layout.state(observation))
        xi_n = layout.output_derivatives(observation)
        if not redesign_kernel.estimates(self.nominal):
            return xi_n
        x = layout.state(observation)
        xi, spread = self.nominal.tau(x), np.apply_along_axis(self.nominal.spread, -1, x)
        return np.clip(xi_n, xi - spread, xi + spread)

    def initial_model_error(self, observation: Array) -> Array:
        """e_star(0) = xi*(0) - xi_d(0) for the first observation of an episode, shape (..., n)."""
        xi_d = layout.reference(observation)[..., :-1]
        if self.model == "reference" or self.initial_model_state == "reference":
            return np.zeros_like(xi_d)
        start = (
            self.measured(observation) if self.initial_model_state == "process" else np.array(self.initial_model_state)
        )
        return start - xi_d

    def first_memory(self, observations: Array) -> Array:
        """Memory before the first control of episodes that begin with these observations, shape (N, m)."""
        memory = np.zeros((len(observations), self.memory_size))
        if self.model == "nonlinear":
            n = self.nominal.order
            xi_star = self.initial_model_error(observations) + layout.reference(observations)[..., :-1]
            for i, observation in enumerate(observations):
                memory[i, :n] = self.nominal.tau_inverse(xi_star[i], guess=layout.state(observation))
        return memory


def redesign(
    name: str,
    nominal: NominalModel,
    *,
    model_poles: Sequence[complex] | None = None,
    poles: Sequence[complex] | None = None,
    k: Sequence[float] | None = None,
    k_tilde: Sequence[float] | None = None,
    design: str = "surface",
    sliding_poles: Sequence[complex] | None = None,
    P: Any = None,
    gain: str = "sharp",
    switching: str = "implicit-observer",
    model: str = "brunovsky",
    feedback: str = "output derivatives",
    initial_model_state: str | Sequence[float] = "process",
    margin: float | None = None,
    width: float = 0.1,
    rate: float | None = None,
    reach_time: float | None = None,
    delta_1: float | None = None,
    delta_3: float | None = None,
) -> LyapunovRedesign:
    """A member of the family; without options the reference policy, chosen by measurement (docs/reference_policy.md).

    Gains come as `k`, `k_tilde` or as poles, by default those of the task. `design` is "paper" (P from Q = I; the model loop at
    half the task's pole: -1 and -4 for the example) or "surface" (P with chosen `sliding_poles`, by default next to the process
    poles); or P itself is given. `reach_time`: by default 0 for exact derivatives, else what leaves a differentiator
    time, at least 2 dt. Raises ValueError for options that cannot work or contradict each other.
    """
    n = nominal.order
    one_of("design", design, MODEL_POLE)
    k_gains = _gains("k", k, "model_poles", model_poles, MODEL_POLE[design] * nominal.model_pole, n)
    k_tilde_gains = _gains("k_tilde", k_tilde, "poles", poles, nominal.process_pole, n)
    one_of("gain", gain, GAINS)
    one_of("switching", switching, SWITCHINGS)
    one_of("model", model, MODELS)
    one_of("feedback", feedback, FEEDBACKS)
    if sliding_poles is not None and (design == "paper" or P is not None):
        raise ValueError(f"`sliding_poles` must come with design = 'surface' and without P, got {sliding_poles}.")
    if P is not None:
        P = lyapunov.positive_definite("P", P, n)
    elif design == "paper":
        P = lyapunov.from_Q(k_tilde_gains)
    else:
        P = _surface_design(k_tilde_gains, sliding_poles)
    lyapunov.positive_definite("dissipation of P", lyapunov.dissipation(P, k_tilde_gains), n)
    if delta_1 is not None:
        positive("delta_1", delta_1, or_zero=True)
    if delta_3 is not None and positive("delta_3", delta_3, or_zero=True) >= 1:
        raise ValueError(f"`delta_3` must lie in [0, 1), got {delta_3}.")
    margin = positive("margin", GAINS[gain].margin if margin is None else margin)
    positive("width", width)
    if rate is not None and positive("rate", rate) > 1:
        raise ValueError(f"`rate` must lie in (0, 1], got {rate}.")
    if reach_time is None:
        exact = nominal.derivatives == "exact" or feedback == "state"
        slow = 1.2 if nominal.noise else 0.2
        reach_time = 0.0 if exact else max(2.0 * nominal.dt, slow / nominal.process_pole)
    positive("reach_time", reach_time, or_zero=True)
    return LyapunovRedesign(
        name, nominal, k_gains, k_tilde_gains, P, gain, switching, model, feedback,
        _start(initial_model_state, n), margin, width, rate, reach_time, delta_1, delta_3,
    )  # fmt: skip


def _surface_design(k_tilde: Array, sliding_poles: Sequence[complex] | None) -> Array:
    """P of the "surface" design: closed form for equal poles, else from the positive real lemma."""
    n = len(k_tilde)
    if sliding_poles is not None:
        c = np.append(lyapunov.place(sliding_poles, "sliding_poles"), 1.0)
        if len(c) != n:
            raise ValueError(f"`sliding_poles` must be {n - 1} poles, got {sliding_poles}.")
        return lyapunov.from_surface(k_tilde, c)
    pole = float(k_tilde[-1]) / n  # minus the mean of the poles
    if np.allclose(k_tilde, lyapunov.place([-pole] * n), rtol=1e-9):
        return lyapunov.equal_poles(pole, n)
    return lyapunov.from_surface(k_tilde)


def _gains(
    name: str, gains: Sequence[float] | None, poles_name: str, poles: Sequence[complex] | None, default: float, n: int
) -> Array:
    if gains is not None and poles is not None:
        raise ValueError(f"`{name}` and `{poles_name}` must not be given together, got {gains} and {poles}.")
    if gains is not None:
        return lyapunov.hurwitz(name, gains, n)
    placed = lyapunov.place([-default] * n if poles is None else poles, poles_name)
    if placed.shape != (n,):
        raise ValueError(f"`{poles_name}` must be {n} poles, got {poles}.")
    return placed


def _start(given: str | Sequence[float], n: int) -> str | tuple[float, ...]:
    if isinstance(given, str):
        one_of("initial_model_state", given, STARTS)
        return given
    return tuple(map(float, vector("initial_model_state", given, n)))
