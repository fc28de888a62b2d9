"""What the scalar and the vector environment share: the plant with its compiled step, the clock, and how an episode begins."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mfc_gym import observation, references, sensing, sensors, stepping
from mfc_gym.checks import mapping, one_of, positive, vector
from mfc_gym.nominal import NominalModel
from mfc_gym.reward import COSTS
from mfc_gym.settings import DERIVATIVES, SCENARIOS, UNCERTAINTY, Settings, measurement, varied_plant
from mfc_gym.streams import Source
from mfc_gym.substeps import choose_substeps

Array = NDArray[np.float64]
Indices = Sequence[int] | NDArray[np.intp]
RESET_OPTIONS = ("initial_state", "theta", "reference_parameters", "initial_estimate")
TABULATED = 20_000  # samples of the reference that are kept, at most
RANGE = 0.999  # of the observation space: what the sensors can read
MOST_SUBSTEPS = 1_000_000
DRAWS = 10_000  # attempts to draw an admissible theta


class Simulation:
    """A plant under zero-order hold with its reference, clock and reward, compiled; immutable once built."""

    def __init__(self, given: Settings, options: Mapping[str, Any]) -> None:
        self._made_from = (given, options)
        one_of("scenario", given.scenario, SCENARIOS)
        one_of("derivatives", given.derivatives, DERIVATIVES)
        one_of("cost", given.cost, COSTS)
        one_of("uncertainty", given.uncertainty, UNCERTAINTY)
        self.plant, self.dt, self.driving = varied_plant(given, options)
        task = self.plant.task
        self.scenario = given.scenario
        self.horizon = positive("horizon", task.horizon if given.horizon is None else given.horizon)
        self.input_limit = positive("input_limit", task.input_limit if given.input_limit is None else given.input_limit)
        cost_max = positive("cost_max", task.cost_max if given.cost_max is None else given.cost_max)
        effort = positive("effort", given.effort, or_zero=True)
        self.steps = round(min(self.horizon / self.dt, 1e15))  # beyond, a float no longer counts every step
        if self.steps < 1 or abs(self.steps * self.dt - self.horizon) > 1e-9 * self.horizon:
            raise ValueError(f"`horizon` must be a multiple of `dt`, got horizon = {self.horizon} and dt = {self.dt}.")
        name = task.reference if given.reference is None else given.reference
        units = task.reference_scale, task.reference_offset, task.reference_rate
        self.reference = references.get(name).scaled(*units)
        own = task.reference_parameters if given.reference in (None, task.reference) else {}
        self.reference_parameters = dict(own) | mapping("reference_parameters", given.reference_parameters)
        parameters = self.reference.parameters(self.reference_parameters)
        self.sensors, tuning = measurement(given)
        self.kernel = stepping.load(
            self.plant, self.reference, given.cost, self.sensors, given.derivatives, self.driving
        )
        self.low, self.high = self.plant.region(self.input_limit)
        noise = (0.0, 0.0) if self.sensors is None else (self.sensors.noise, self.sensors.state_noise)
        poles = (task.model_pole, task.process_pole)
        self.nominal = NominalModel(self.plant.nominal, self.dt, self.input_limit, *poles, given.derivatives, *noise)
        p = len(self.plant.theta)
        self.beyond = given.uncertainty == "beyond"
        self.theta_set, usual = self._theta_of(UNCERTAINTY[given.uncertainty])
        self.theta = vector("theta", usual if given.theta is None else given.theta, p)
        origin = (0.0,) * self.plant.order if task.initial_state is None else task.initial_state
        self.initial_state = vector(
            "initial_state", origin if given.initial_state is None else given.initial_state, self.plant.order
        )
        rest = np.zeros(len(self.plant.parameters) - p)
        memory = np.full(sensing.sensor_memory(self.plant.order, self.sensors), np.nan)
        moving = np.zeros(self.driving.memory)
        self._start = np.concatenate([self.initial_state, self.theta, rest, parameters, memory, moving, [0.0]])
        self._check_state(self._start[None])
        if self.scenario != "random" or given.theta is not None:
            self._check_theta(self._start[None])
        self._drawn = self._sets(given)
        if given.substeps is None:
            tolerance = positive("tolerance", given.tolerance)
            count = choose_substeps(self.plant, self.parameter_set, self.dt, self.input_limit, tolerance)
            self.substeps = max(count, self.driving.substeps(self.dt))
        elif type(given.substeps) is int and 1 <= given.substeps <= MOST_SUBSTEPS:
            self.substeps = given.substeps
        else:
            raise ValueError(f"`substeps` must be an integer from 1 to {MOST_SUBSTEPS}, got {given.substeps!r}.")
        clock = [self.dt, self.substeps, self.input_limit, self.steps, cost_max, effort]
        if self.sensors is not None:
            space, measured = self.observation_space, slice(2 * self.plant.order)
            middle, half = (space.high + space.low)[measured] / 2, (space.high - space.low)[measured] / 2
            tuning += [*(middle - RANGE * half), *(middle + RANGE * half)]
        self.settings = np.array([*clock, *self.low, *self.high, *tuning, *self.driving.tuning])

    @classmethod
    def from_keywords(cls, keywords: Mapping[str, Any]) -> "Simulation":
        """From the options of `Settings` by name; further keywords go to the plant."""
        own = {field.name for field in fields(Settings)}
        given = Settings(**{name: value for name, value in keywords.items() if name in own})
        return cls(given, {name: value for name, value in keywords.items() if name not in own})

    def _theta_of(self, factor: float) -> tuple[tuple[Array, Array], Array]:
        """(low, high) of the theta drawn at random, and the usual theta, at this factor of their distance from the nominal."""
        low, high = self.plant.theta_set
        nominal, task = np.clip(0.0, low, high), self.plant.task
        usual = (low + high) / 2 if task.theta is None else np.array(task.theta[: len(low)])
        return (nominal + factor * (low - nominal), nominal + factor * (high - nominal)), nominal + factor * (
            usual - nominal
        )

    @property
    def parameter_set(self) -> tuple[Array, Array]:
        """(low, high) of all uncertain parameters, those that move and disturbances included."""
        low, high = self.plant.parameter_set
        for ends, own in zip((low, high), self.theta_set, strict=True):
            ends[: len(own)] = own
        for mover in self.driving.movers:
            if mover.declared:
                low[mover.columns[0]] += mover.extent[0]
                high[mover.columns[0]] += mover.extent[1]
        return low, high

    def __reduce__(self) -> tuple[Any, ...]:
        return Simulation, self._made_from

    def memory(self) -> Array:
        """What the scalar environment's step works in: [row, settings, observation]."""
        size = self._start.size + self.settings.size + observation.size(self.plant.order)
        found = np.zeros(size)
        found[self._start.size : self._start.size + self.settings.size] = self.settings
        return found

    def outputs(self, rows: Array) -> Array:
        """The true y of episodes, shape (m,)."""
        y = np.empty(len(rows))
        self.kernel.outputs(rows, y)
        return y

    def table(self, rows: Array) -> Array:
        """The reference at the samples 0, 1, ..., (N, n+1), if it is the same in all these episodes; else no samples."""
        same = (self.row_reference(rows) == self.row_reference(self._start)).all()
        return self._tables[0 if same else 1]

    @cached_property
    def _tables(self) -> tuple[Array, Array]:
        table = np.empty((min(self.steps, TABULATED) + 1, self.plant.order + 1))
        self.kernel.tabulate(self.row_reference(self._start).copy(), self.dt, table)
        return table, table[:0]

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
        low, high = self.parameter_set
        usual = np.concatenate([self.theta, np.zeros(len(low) - len(self.theta))])
        theta = np.vstack([low, high, usual, rng.uniform(low, high, (61, len(low)))])
        x = centre + half * rng.choice([-1.0, 0.0, 1.0], (64, n))
        x[0], x[1] = centre - half, centre + half
        xi_n = np.empty((64 * 16, n))
        self.plant.kernel.output_derivatives_all(np.repeat(x, 16, axis=0), np.tile(theta[:16], (64, 1)), xi_n)
        extremes = self.reference.extremes(self.reference_parameters)
        tables = np.empty((len(extremes), 64, n + 1))
        for parameters, table in zip(extremes, tables, strict=True):
            self.kernel.tabulate(parameters, self.horizon / 63, table)
        yd = np.abs(tables).max(axis=(0, 1))
        above = np.concatenate([centre + half, 2.0 * np.abs(xi_n).max(axis=0), 2.0 * yd + 1.0])
        below = np.concatenate([centre - half, -above[n:]])
        assert above.size == observation.size(n)
        return spaces.Box(below, above, dtype=np.float64)

    def success(self, rows: Array, observations: Array, terminated: Any) -> Any:
        """Whether episodes ended on the horizon, with abs(y - y_d) of the true y within the task's success error; shape (m,)."""
        error = np.abs(self.outputs(rows) - observations[:, 2 * self.plant.order])
        return np.logical_not(terminated) & (error <= self.plant.task.success_error)

    # -- beginning episodes -------------------------------------------------------------------------------------------

    def begin(
        self,
        source: Source,
        options: Mapping[str, Any] | None,
        chosen: Indices = (0,),
        num_envs: int | None = None,
    ) -> Array:
        """New episodes of the environments `chosen` (m,), one row each: shape (m, row), see `mfc_gym.stepping`.

        `options` may set `initial_state`, `theta` and `reference_parameters`; with `num_envs` also for each environment
        (leading axis). In the random scenario the rest is drawn from each environment's own stream: first theta, then
        the initial state, then the reference.
        """
        options = mapping("options", options)
        if unknown := set(options) - set(RESET_OPTIONS):
            raise ValueError(f"`options` must be among {RESET_OPTIONS}, got {sorted(map(str, unknown))}.")
        given = self._given(options, chosen, num_envs) if options else []
        rows = np.empty((len(chosen), self._start.size))
        rows[:] = self._start
        if self._drawn is not None:
            streams = source.take(chosen)
            if not self.kernel.draw_all(rows, streams, *self._drawn):
                low, high = self.theta_set
                raise ValueError(f"`theta` could not be drawn: none of {DRAWS} from {low} to {high} is admissible.")
            source.put(chosen, streams)
        for columns, values in given:
            rows[:, columns] = values
        if given:
            self._check_state(rows, chosen)
            self._check_theta(rows, chosen)
        if self.driving.moves:
            self.kernel.start_all(rows, self.settings)
        return rows

    def fresh(self) -> Array:
        """The row that every episode begins with, shape (row,), if nothing is drawn; else shape (0,)."""
        if self._drawn is not None:
            return np.empty(0)
        row = self._start[None].copy()
        if self.driving.moves:
            self.kernel.start_all(row, self.settings)
        return row[0]

    def set_theta(self, rows: Array, theta: Any, num_envs: int | None = None) -> None:
        """New declared theta for running episodes, (p,) or one for each; what is scheduled moves on about it.

        Raises ValueError for theta that are not admissible; the rows are then as they were.
        """
        changed, n, p = rows.copy(), self.plant.order, len(self.plant.theta)
        changed[:, n : n + p] = vector("theta", theta, p, num_envs)
        self._check_theta(changed, range(len(rows)))
        rows[:, n : n + p] = changed[:, n : n + p]
        if self.driving.moves:
            self.kernel.set_all(rows, self.settings)

    @property
    def row_size(self) -> int:
        """Numbers that an episode is made of, see `mfc_gym.stepping`."""
        return int(self._start.size)

    def row_theta(self, row: Array) -> Array:
        """The true theta of an episode."""
        n = self.plant.order
        return row[..., n : n + len(self.plant.theta)]

    def row_reference(self, row: Array) -> Array:
        """The reference parameters of an episode."""
        start = self.plant.order + len(self.plant.parameters)
        return row[..., start : start + len(self.reference.defaults)]

    @property
    def _memory(self) -> int:
        """Where the sensor memory of a row begins."""
        return self.plant.order + len(self.plant.parameters) + len(self.reference.defaults)

    def _given(self, options: dict[str, Any], chosen: Indices, num_envs: int | None) -> list[tuple[Any, Any]]:
        """(columns of the rows, their values) that the options of a reset ask for."""
        n, p, all_p = self.plant.order, len(self.plant.theta), len(self.plant.parameters)
        given: list[tuple[Any, Any]] = []
        if self.sensors is None and "initial_estimate" in options:
            raise ValueError("`initial_estimate` must come with a differentiator, got derivatives = 'exact'.")
        first = self._memory + 2 + n
        for name, columns, size in (
            ("initial_state", slice(n), n),
            ("theta", slice(n, n + p), p),
            ("initial_estimate", slice(first, first + n), n),
        ):
            if name in options:
                values = vector(name, options[name], size, num_envs)
                given.append((columns, values if values.ndim == 1 else values[chosen]))
        parameters = mapping("reference_parameters", options.get("reference_parameters"))
        each = {name: np.asarray(v) for name, v in parameters.items() if num_envs is not None and np.ndim(v)}
        for name, values in each.items():
            if values.shape != (num_envs,) or values.dtype.kind not in "iuf":
                raise ValueError(
                    f"`{name}` of the reference must be one number or {num_envs}, got {parameters[name]!r}."
                )
        for i in range(num_envs if each and num_envs else 1):
            self.reference.parameters(parameters | {name: values[i] for name, values in each.items()})
        names = list(self.reference.defaults)
        for name, value in parameters.items():
            given.append((n + all_p + names.index(name), each[name][chosen] if name in each else value))
        return given

    def _sets(self, given: Settings) -> tuple[int, bool, Array, Array, NDArray[np.intp], Array, Array] | None:
        """What `draw_all` draws at the beginning of an episode; None: nothing."""
        n, names = self.plant.order, list(self.reference.defaults)
        drawn: list[tuple[int, float, float]] = []  # column of the row (-1: given, hence dropped), low, high
        if self.scenario == "random":
            for i, name in enumerate(self.plant.state):
                if given.initial_state is None and name in self.plant.task.initial_set:
                    low, high = np.clip(self.plant.task.initial_set[name], self.low[i], self.high[i])
                    drawn.append((i, low, high))
            for name, (low, high) in self.reference.sets.items():
                column = n + len(self.plant.parameters) + names.index(name)
                drawn.append((-1 if name in self.reference_parameters else column, low, high))
        attempts = DRAWS if self.scenario == "random" and given.theta is None else 0
        if self.sensors is not None:
            drawn.append((self._memory, 0.0, sensors.KEYS))
        if any(mover.family == "noise" for mover in self.driving.movers):
            column = self._memory + sensing.sensor_memory(n, self.sensors) + len(self.driving.movers)
            drawn.append((column, 0.0, sensors.KEYS))
        if not drawn and not attempts:
            return None
        columns, low, high = np.array(drawn).reshape(-1, 3).T.copy()
        return attempts, self.beyond, *self.theta_set, columns.astype(np.intp), low, high

    def _check_state(self, rows: Array, chosen: Indices = (0,)) -> None:
        n = self.plant.order
        where = [""] if len(rows) == 1 else [f" in environment {i}" for i in chosen]
        x = rows[:, :n]
        for i in np.flatnonzero(~((self.low <= x) & (x <= self.high)).all(axis=1))[:1]:
            raise ValueError(
                f"`initial_state` must lie in the operating region {self.low} to {self.high}, got {x[i]}{where[i]}."
            )

    def _check_theta(self, rows: Array, chosen: Indices = (0,)) -> None:
        where = [""] if len(rows) == 1 else [f" in environment {i}" for i in chosen]
        found = np.empty(2)
        i = self.kernel.inadmissible(rows, self.beyond, found)
        moves = " where it is scheduled to go" if any(mover.declared for mover in self.driving.movers) else ""
        if i >= 0:
            Delta_3, delta_3 = found
            raise ValueError(
                f"`theta` must keep abs(Delta_3) <= delta_3 = {delta_3:g}, "
                f"got theta = {tuple(map(float, self.row_theta(rows[i])))} with Delta_3 = {Delta_3:g}{moves}{where[i]}."
            )
