"""The exact closed loop: the continuous-time law in Filippov's sense, solved event by event.

Between events the right-hand side is smooth: s > 0 (mode +1), s < 0 (mode -1), or s = 0 (mode 0, sliding with the equivalent
control), where w = 2 s. Sliding lasts while both fields push towards the surface; each end of it is an event.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from baselines import closed_loop
from baselines.controller import Controller
from baselines.redesign import LyapunovRedesign
from baselines.rollout import require_limit
from mfc_gym import observation as layout

Array = NDArray[np.float64]
MAX_EVENTS = 10_000
MAX_STEP = 0.02  # s; events are looked for at the ends of solver steps
EDGE = 1e-12  # slack of the sliding condition, relative to the rate of s


@dataclass(frozen=True)
class Segment:
    """A stretch of time in one mode; `solution(t)` is the stacked state q = (x, e_star)."""

    mode: int
    begin: float
    end: float
    solution: Callable[[Any], Array]


@dataclass(frozen=True)
class Flow:
    """The closed loop in continuous time for one episode."""

    kernel: ModuleType
    controller: LyapunovRedesign
    theta: Array
    reference_parameters: Array
    low: Array  # of the operating region
    high: Array

    @property
    def n(self) -> int:
        return len(self.low)

    @cached_property
    def _constants(self) -> tuple[Any, ...]:
        return self.theta, self.reference_parameters, self.controller.law

    def rhs(self, mode: int) -> Callable[[float, Array], Array]:
        evaluate, constants, size = self.kernel.evaluate_one, self._constants, 2 * self.n
        return lambda t, q: evaluate(t, q, mode, *constants)[:size]

    def surface(self, t: float, q: Array) -> float:
        """s = w / 2."""
        return float(self.kernel.evaluate_one(t, q, 1, *self._constants)[2 * self.n + 1])

    def push(self, t: float, q: Array) -> tuple[float, float]:
        """s' under the input of mode +1 and of mode -1, each over its size: sliding while the first <= 0 <= the second."""
        values = self.kernel.evaluate_one(t, q, 1, *self._constants)
        return float(values[2 * self.n + 2]), float(values[2 * self.n + 3])

    def margin(self, q: Array) -> float:
        """Distance to the end of the operating region, over its size; negative outside."""
        x = q[: self.n]
        return float((np.minimum(x - self.low, self.high - x) / (self.high - self.low)).min())

    def events(self, mode: int) -> list[Any]:
        """Terminal events of a mode: the end of the region, and the surface reached or the sliding condition lost."""

        def leave(t: float, q: Array) -> float:
            return self.margin(q)

        def lose_plus(t: float, q: Array) -> float:
            return self.push(t, q)[0] - EDGE

        def lose_minus(t: float, q: Array) -> float:
            return self.push(t, q)[1] + EDGE

        def reach(t: float, q: Array) -> float:
            return self.surface(t, q)

        chosen: list[tuple[Any, float]] = [(leave, -1.0)]
        chosen += [(reach, -float(mode))] if mode else [(lose_plus, 1.0), (lose_minus, -1.0)]
        for event, direction in chosen:
            event.terminal = True
            event.direction = direction
        return [event for event, _ in chosen]

    def mode_on_surface(self, t: float, q: Array, before: int) -> int:
        """The mode after s = 0: sliding if both fields push towards it, else the side they push to."""
        plus, minus = self.push(t, q)
        if plus <= EDGE and minus >= -EDGE:
            return 0
        return -before if before else (1 if plus > 0 else -1)

    def initial_mode(self, q: Array) -> int:
        """The mode an episode starts in."""
        s = self.surface(0.0, q)
        if abs(s) > 1e-14 * np.abs(self.controller.P[:, -1]).max() * (1.0 + np.abs(q).max()):
            return 1 if s > 0 else -1
        return self.mode_on_surface(0.0, q, 0)


@dataclass(frozen=True)
class ExactSolution:
    """Dense solution of the closed loop over [0, end]."""

    flow: Flow
    segments: tuple[Segment, ...]
    terminated: bool  # left the operating region

    @property
    def end(self) -> float:
        """Last time, s."""
        return self.segments[-1].end

    @property
    def switching_times(self) -> Array:
        """Times at which the mode changes, s."""
        return np.array([segment.begin for segment in self.segments[1:]])

    @property
    def modes(self) -> tuple[int, ...]:
        """The modes in their order: +1, -1, 0 = sliding."""
        return tuple(segment.mode for segment in self.segments)

    def __call__(self, t: float | Array) -> tuple[Array, Array, Array]:
        """(xi, xi_star, u) at times t (s): shapes t.shape + (n,), the same, t.shape. xi = tau(x); u the equivalent control."""
        signals = self.signals(t)
        return signals["xi"], signals["xi_star"], signals["u"]

    def state(self, t: float | Array) -> Array:
        """x, shape t.shape + (n,)."""
        return self.signals(t)["x"]

    def output_derivatives(self, t: float | Array) -> Array:
        """xi_n, shape t.shape + (n,)."""
        return self.signals(t)["xi_n"]

    def signals(self, t: float | Array) -> dict[str, Array]:
        """All signals at times t (s): x, xi, xi_n, xi_star, reference, u, w, Gamma, error.

        At a change of mode the later mode counts. Raises ValueError for times outside [0, end].
        """
        times = np.asarray(t, dtype=float)
        if not (np.isfinite(times).all() and (times >= 0).all() and (times <= self.end + 1e-12).all()):
            raise ValueError(f"`t` must lie in [0, {self.end}], got {t}.")
        n, flat = self.flow.n, np.minimum(times.ravel(), self.end)
        index = np.searchsorted(self.switching_times, flat, side="right")
        q = np.empty((flat.size, 2 * n))
        for i in np.unique(index):
            q[index == i] = self.segments[i].solution(flat[index == i]).T
        modes = np.array(self.modes)[index]
        values = self.flow.kernel.evaluate_all(flat, q, modes, *self.flow._constants)
        ends = np.cumsum([2 * n, 1, 1, 2, 1, n, n])
        _, u, s, _, Gamma, xi_n, xi, reference = np.split(values, ends, axis=1)
        out = {
            "x": q[:, :n],
            "xi": xi,
            "xi_n": xi_n,
            "xi_star": q[:, n:] + reference[:, :-1],
            "reference": reference,
            "u": u[:, 0],
            "w": 2.0 * s[:, 0],
            "Gamma": Gamma[:, 0],
            "error": xi[:, 0] - reference[:, 0],
        }
        return {name: value.reshape(times.shape + value.shape[1:]) for name, value in out.items()}


def filippov(
    env: Any,
    controller: Controller,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    rtol: float = 1e-12,
    atol: float = 1e-14,
) -> ExactSolution:
    """Solve the closed loop of the environment's plant and the controller's continuous-time law over the horizon.

    The episode is the one `env.reset(seed=seed, options=options)` gives. Raises TypeError for a controller without such a law,
    ValueError for an environment it is not made for, or a vector one, and RuntimeError if the solver fails or the modes change
    more than 10^4 times.
    """
    if not isinstance(controller, LyapunovRedesign):
        raise TypeError(f"`controller` must be of the redesign family, got {type(controller).__name__}.")
    if hasattr(env, "num_envs"):
        raise ValueError(f"`env` must be a scalar environment for the exact solution, got {env}.")
    nominal = env.unwrapped.nominal
    if controller.nominal.kernel is not nominal.kernel:
        raise ValueError(
            f"`controller` must be made for this environment's plant, got one for {controller.nominal.name!r}."
        )
    require_limit(controller, nominal.input_limit)
    if env.unwrapped.simulation.driving.moves:
        raise ValueError(
            "`env` must have constant theta and an ideal actuator for the exact solution, got some that move."
        )
    observation, _ = env.reset(seed=seed, options=options)
    plain, simulation = env.unwrapped, env.unwrapped.simulation
    kernel = closed_loop.load(simulation.plant, simulation.reference, controller)
    flow = Flow(kernel, controller, plain.theta, plain.reference_parameters, simulation.low, simulation.high)
    t, q = 0.0, np.concatenate([layout.state(observation), controller.initial_model_error(observation)])
    mode = flow.initial_mode(q)
    segments: list[Segment] = []
    while t < simulation.horizon:
        if len(segments) > MAX_EVENTS:
            raise RuntimeError(f"more than {MAX_EVENTS} changes of mode before t = {t}: the gain has no margin.")
        result = solve_ivp(
            flow.rhs(mode), (t, simulation.horizon), q, method="DOP853", rtol=rtol, atol=atol,
            events=flow.events(mode), dense_output=True, max_step=MAX_STEP,
        )  # fmt: skip
        if result.status < 0:
            raise RuntimeError(f"integration failed at t = {result.t[-1]}: {result.message}")
        segments.append(Segment(mode, t, float(result.t[-1]), result.sol))
        t, q = float(result.t[-1]), result.y[:, -1]
        if result.status == 1 and result.t_events[0].size:
            return ExactSolution(flow, tuple(segments), True)
        if result.status == 1:
            mode = flow.mode_on_surface(t, q, mode) if mode else (1 if result.t_events[1].size else -1)
    return ExactSolution(flow, tuple(segments), False)
