"""What the scalar and the vector environment share: the plant with its compiled step, the clock, and how an episode begins."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mfc_gym import observation, plant, references, stepping
from mfc_gym.nominal import NominalModel
from mfc_gym.reward import COSTS
from mfc_gym.substeps import choose_substeps

Array = NDArray[np.float64]
SCENARIOS = ("paper", "random")
DERIVATIVES = ("exact",)
RESET_OPTIONS = ("initial_state", "theta", "reference_parameters")
DRAWS = 10_000  # attempts to draw an admissible theta


@dataclass(frozen=True)
class Settings:
    """Options of the environment; None means the plant's own task."""

    system: str = "PerturbedChain"
    scenario: str = "paper"
    theta: tuple[float, ...] | None = None
    initial_state: tuple[float, ...] | None = None
    reference: str | None = None
    reference_parameters: Mapping[str, float] | None = None
    derivatives: str = "exact"
    dt: float | None = None  # s
    horizon: float | None = None  # s
    input_limit: float | None = None
    cost: str = "absolute"
    cost_max: float | None = None
    effort: float = 0.0  # weight of u^2 in the cost
    tolerance: float = 1e-8  # error of the plant's integration per control step
    substeps: int | None = None  # None: from the tolerance


class Simulation:
    """A plant under zero-order hold with its reference, clock and reward, compiled; immutable once built."""

    def __init__(self, given: Settings, options: Mapping[str, Any]) -> None:
        self._made_from = (given, options)
        _one_of("scenario", given.scenario, SCENARIOS)
        _one_of("derivatives", given.derivatives, DERIVATIVES)
        _one_of("cost", given.cost, COSTS)
        self.plant = plant.load(given.system, **options)
        task = self.plant.task
        self.scenario = given.scenario
        self.dt = _positive("dt", task.dt if given.dt is None else given.dt)
        self.horizon = _positive("horizon", task.horizon if given.horizon is None else given.horizon)
        self.input_limit = _positive(
            "input_limit", task.input_limit if given.input_limit is None else given.input_limit
        )
        cost_max = _positive("cost_max", task.cost_max if given.cost_max is None else given.cost_max)
        effort = _positive("effort", given.effort, or_zero=True)
        self.steps = round(min(self.horizon / self.dt, 1e15))  # beyond, a float no longer counts every step
        if self.steps < 1 or abs(self.steps * self.dt - self.horizon) > 1e-9 * self.horizon:
            raise ValueError(f"`horizon` must be a multiple of `dt`, got horizon = {self.horizon} and dt = {self.dt}.")
        name = task.reference if given.reference is None else given.reference
        self.reference = references.get(name)
        own = task.reference_parameters if given.reference in (None, task.reference) else {}
        self.reference_parameters = dict(own) | _dict("reference_parameters", given.reference_parameters)
        self.reference.parameters(self.reference_parameters)
        self.low, self.high = self.plant.region(self.input_limit)
        self.nominal = NominalModel(self.plant.nominal, self.dt, self.input_limit, task.model_pole, task.process_pole)
        p = len(self.plant.theta)
        low, high = self.plant.theta_set
        middle = tuple((low + high) / 2) if task.theta is None else task.theta
        self.theta = _vector("theta", middle if given.theta is None else given.theta, p)
        origin = (0.0,) * self.plant.order if task.initial_state is None else task.initial_state
        self.initial_state = _vector(
            "initial_state", origin if given.initial_state is None else given.initial_state, self.plant.order
        )
        self._fixed = frozenset(name for name in ("theta", "initial_state") if getattr(given, name) is not None)
        self._check_state(self.initial_state)
        self._check_theta(self.theta, self.initial_state)
        if given.substeps is None:
            self.substeps = choose_substeps(
                self.plant, self.dt, self.input_limit, _positive("tolerance", given.tolerance)
            )
        elif isinstance(given.substeps, int) and not isinstance(given.substeps, bool) and given.substeps >= 1:
            self.substeps = given.substeps
        else:
            raise ValueError(f"`substeps` must be an integer >= 1, got {given.substeps!r}.")
        self.kernel = stepping.load(self.plant, self.reference, given.cost)
        self.settings = np.array(
            [self.dt, self.substeps, self.input_limit, self.steps, cost_max, effort, *self.low, *self.high]
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return Simulation, self._made_from

    # -- spaces -------------------------------------------------------------------------------------------------------

    @property
    def action_space(self) -> spaces.Box:
        """u / input_limit."""
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    @property
    def observation_space(self) -> spaces.Box:
        """Twice the operating region, what tau_n makes of it over the theta set, and twice what the reference may be."""
        n, rng = self.plant.order, np.random.default_rng(0)
        centre, half = (self.low + self.high) / 2, self.high - self.low
        low, high = self.plant.theta_set
        theta = np.vstack([low, high, self.theta, rng.uniform(low, high, (61, len(low)))])
        x = centre + half * rng.choice([-1.0, 0.0, 1.0], (64, n))
        x[0], x[1] = centre - half, centre + half
        xi_n = np.abs([self.plant.kernel.output_derivatives_at(a, b) for a in x for b in theta[:16]])
        extremes = self.reference.extremes(self.reference_parameters)
        times = np.linspace(0.0, self.horizon, 64)
        yd = np.max([np.abs(self.reference.evaluate(times, p, n)).max(axis=0) for p in extremes], axis=0)
        above = np.concatenate([centre + half, 2.0 * xi_n.max(axis=0), 2.0 * yd + 1.0])
        below = np.concatenate([centre - half, -above[n:]])
        assert above.size == observation.size(n)
        return spaces.Box(below, above, dtype=np.float64)

    def success(self, observation: Array, terminated: bool) -> bool:
        """Whether an episode ended on the horizon, with abs(y - y_d) within the task's success error."""
        n = self.plant.order
        return not terminated and bool(abs(observation[n] - observation[2 * n]) <= self.plant.task.success_error)

    # -- beginning an episode -----------------------------------------------------------------------------------------

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Array:
        """A new episode as one row. `options` may set `initial_state`, `theta` and `reference_parameters`.

        In the random scenario the rest is drawn from `rng`: first theta, then the initial state, then the reference.
        """
        options = _dict("options", options)
        if unknown := set(options) - set(RESET_OPTIONS):
            raise ValueError(f"`options` must be among {RESET_OPTIONS}, got {sorted(map(str, unknown))}.")
        random = self.scenario == "random"
        theta, state = self.theta, self.initial_state
        if random and "theta" not in self._fixed:
            theta = self._draw_theta(rng)
        if random and "initial_state" not in self._fixed:
            state = self._draw_state(rng)
        given = self.reference_parameters | _dict("reference_parameters", options.get("reference_parameters"))
        parameters = self.reference.draw(rng, given) if random else self.reference.parameters(given)
        if "theta" in options:
            theta = _vector("theta", options["theta"], len(self.plant.theta))
        if "initial_state" in options:
            state = _vector("initial_state", options["initial_state"], self.plant.order)
            self._check_state(state)
        if options:
            self._check_theta(theta, state)
        return np.concatenate([state, theta, parameters, [0.0]])

    def row_theta(self, row: Array) -> Array:
        """The true theta of an episode."""
        n = self.plant.order
        return row[..., n : n + len(self.plant.theta)]

    def row_reference(self, row: Array) -> Array:
        """The reference parameters of an episode."""
        n = self.plant.order + len(self.plant.theta)
        return row[..., n:-1]

    def admissible(self, theta: Array, state: Array) -> bool:
        """Whether abs(Delta_3) <= delta_3, what every redesign controller is told."""
        Delta_3 = self.plant.kernel.uncertainty_at(state, theta)[1]
        return bool(abs(Delta_3) <= self.nominal.delta_3(state) * (1 + 1e-12))

    def _draw_theta(self, rng: np.random.Generator) -> Array:
        low, high = self.plant.theta_set
        for _ in range(DRAWS):
            theta = rng.uniform(low, high)
            if self.admissible(theta, self.initial_state):
                return theta
        raise ValueError(f"`theta` could not be drawn: no admissible value among {DRAWS} from [{low}, {high}].")

    def _draw_state(self, rng: np.random.Generator) -> Array:
        state = self.initial_state.copy()
        for i, name in enumerate(self.plant.state):
            if name in self.plant.task.initial_set:
                state[i] = rng.uniform(*np.clip(self.plant.task.initial_set[name], self.low[i], self.high[i]))
        return state

    def _check_state(self, state: Array) -> None:
        if not ((self.low <= state) & (state <= self.high)).all():
            raise ValueError(
                f"`initial_state` must lie in the operating region {self.low} to {self.high}, got {state}."
            )

    def _check_theta(self, theta: Array, state: Array) -> None:
        if not self.admissible(theta, state):
            Delta_3 = self.plant.kernel.uncertainty_at(state, theta)[1]
            raise ValueError(
                f"`theta` must keep abs(Delta_3) <= delta_3 = {self.nominal.delta_3(state):g}, "
                f"got theta = {tuple(map(float, theta))} with Delta_3 = {Delta_3:g}."
            )


def _one_of(name: str, value: object, known: Iterable[str]) -> None:
    if value not in tuple(known):
        raise ValueError(f"`{name}` must be one of {sorted(known)}, got {value!r}.")


def _positive(name: str, value: float, or_zero: bool = False) -> float:
    number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not number or value < 0 or (value == 0 and not or_zero):
        raise ValueError(f"`{name}` must be {'>= 0' if or_zero else 'positive'} and finite, got {value!r}.")
    return float(value)


def _vector(name: str, value: Any, size: int) -> Array:
    try:
        vector = np.array(value)
    except ValueError:  # ragged
        vector = np.array(None)
    if vector.shape != (size,) or vector.dtype.kind not in "iuf" or not np.isfinite(vector).all():
        raise ValueError(f"`{name}` must be {size} finite numbers, got {value!r}.")
    return vector.astype(float)


def _dict(name: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ValueError(f"`{name}` must be a dict, got {value!r}.")
    return dict(value)
