"""The vector environment: many episodes at once, rows of one array, stepped by the scalar environment's kernel."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mfc_gym import team
from mfc_gym.checks import one_of
from mfc_gym.compiled import Bound, bind_all
from mfc_gym.nominal import NominalModel
from mfc_gym.simulation import Simulation
from mfc_gym.stepping import BLOCK
from mfc_gym.streams import ManyStreams

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

THREAD_WORK = 25_000  # substeps of all environments (and 4 more each) that pay for one thread, even if it must be woken
COPIED = 512  # environments up to which it is faster to copy results than to say where new arrays are
BOUND = ("_steps", "_own_step")  # what refers to the very arrays of an environment


class TrackingVectorEnv(VectorEnv[Array, NDArray[Any], NDArray[Any]]):
    """`num_envs` environments as `mfc_gym.env.TrackingEnv`, with its options, at once.

    Seed s gives environment i, bit for bit, the episodes of a scalar environment seeded s + i; a list gives each its own.
    `autoreset_mode` says what becomes of an environment whose episode has ended: NEXT_STEP begins the next one in the
    next step, whose action is ignored; SAME_STEP begins it at once and leaves the end in `info["final_obs"]` and
    `info["final_info"]`; DISABLED waits for `reset(options={"reset_mask": mask})`, which works in every mode. The other
    options of `reset` hold for all environments or, with a leading axis of `num_envs`, for each.
    `threads`: None for as many cores as pay.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: None = None,
        **options: Any,
    ) -> None:
        self.num_envs = _count("num_envs", num_envs)
        if render_mode is not None:
            raise ValueError(f"`render_mode` must be None, a vector environment draws nothing, got {render_mode!r}.")
        one_of("autoreset_mode", autoreset_mode, (*AutoresetMode, *(mode.value for mode in AutoresetMode)))
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.simulation = Simulation.from_keywords(options)
        if max_episode_steps is not None and _count("max_episode_steps", max_episode_steps) < self.simulation.steps:
            raise ValueError(
                f"`max_episode_steps` must be at least horizon / dt = {self.simulation.steps}, got {max_episode_steps}: "
                "the environment owns its clock, set `horizon`."
            )
        self.single_action_space = self.simulation.action_space
        self.single_observation_space = self.simulation.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._columns = np.full((self.simulation.row_size, num_envs), np.nan)  # one episode each
        self._shape = (num_envs, *self.single_observation_space.shape)
        self._streams = ManyStreams(num_envs)
        self._actions, self._actions_shape = np.empty(num_envs), (num_envs, 1)
        self._running = np.ones(num_envs, dtype=bool)
        self._waiting = np.arange(0)  # where the episode has ended and the next one has not begun
        self._final = (
            np.arange(0),
            np.empty((0, self.simulation.row_size)),
        )  # where the next began at once: the rows before
        self._begun = False  # whether every environment has been reset
        if threads is None:
            work = num_envs * (self.simulation.substeps + 4)
            threads = min(team.cores(), max(1, work // THREAD_WORK))
        self._spans = spans(num_envs, _count("threads", threads))
        self._fresh = self.simulation.fresh()
        self._table = self.simulation.table(self._columns[:, :0].T)  # of all episodes so far

    @property
    def nominal(self) -> NominalModel:
        """What a controller may know."""
        return self.simulation.nominal

    @property
    def dt(self) -> float:
        """Sampling time, s."""
        return self.simulation.dt

    @property
    def rows(self) -> Array:
        """The episodes as they are, see `mfc_gym.stepping`, shape (num_envs, row)."""
        self._require_reset()
        return np.ascontiguousarray(self._columns.T)

    @property
    def output(self) -> Array:
        """The true y = h(x) now, shape (num_envs,)."""
        return self.simulation.outputs(self.rows)

    @property
    def final_output(self) -> Array:
        """The true y with which the last episodes to end under SAME_STEP ended, shape (num_envs,), NaN for the others."""
        chosen, rows = self._final
        final = np.full(self.num_envs, np.nan)
        final[chosen] = self.simulation.outputs(rows)
        return final

    @property
    def theta(self) -> Array:
        """The true uncertain parameters now, shape (num_envs, p); may be set to (p,) or (num_envs, p), also within episodes."""
        return self.simulation.row_theta(self.rows)

    @theta.setter
    def theta(self, theta: Any) -> None:
        rows = self.rows
        self.simulation.set_theta(rows, theta, self.num_envs)
        self._columns[:] = rows.T

    @property
    def reference_parameters(self) -> Array:
        """The parameters of the episodes' references, shape (num_envs, r)."""
        return self.simulation.row_reference(self.rows)

    @property  # type: ignore[misc]  # Gymnasium's is one generator with a setter; a tuple as in SyncVectorEnv
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """A copy of each environment's generator."""
        return self._streams.generators()

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each environment."""
        return self._streams.seeds()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        chosen = np.arange(self.num_envs)
        if isinstance(options, Mapping) and "reset_mask" in options:
            chosen = np.flatnonzero(self._mask(options["reset_mask"]))
            options = {name: value for name, value in options.items() if name != "reset_mask"}
        if seed is not None:
            self._streams.reseed(chosen, self._seeds(seed))
        self._begin(chosen, options)
        self._running[chosen] = True
        self._waiting = np.flatnonzero(~self._running)
        self._begun = not np.isnan(self._columns[-1]).any()
        observations = np.empty(self._shape)
        self._observe(np.ones(self.num_envs, dtype=bool), observations)
        return observations, {}

    def step(self, actions: Any) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        self._require_running()
        self._take(actions)
        if self._waiting.size and not self._fresh.size:
            self._begin(self._waiting, None)
        try:
            observations, rewards, (terminated, truncated) = self._advance()
        except BaseException:  # an interrupt: some have taken the step, others have not
            self._begun = False
            raise
        ended = terminated | truncated
        chosen = ended.nonzero()[0]
        info = self._info(observations, terminated, ended, chosen) if chosen.size else {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            np.logical_not(ended, out=self._running)
            self._waiting = chosen
        elif chosen.size:
            self._final = chosen, np.ascontiguousarray(self._columns[:, chosen].T)
            self._begin(chosen, None)
            self._observe(ended, observations)
        return observations, rewards, terminated, truncated, info

    def _begin(self, chosen: NDArray[np.intp], options: Mapping[str, Any] | None) -> None:
        rows = self.simulation.begin(self._streams, options, chosen, self.num_envs)
        self._columns[:, chosen] = rows.T
        differ = options or self.simulation.scenario == "random"
        table = self.simulation.table(rows if differ else rows[:0])
        if table is not self._table and (chosen.size == self.num_envs or not table.size):
            self._table = table
            for name in BOUND:
                self.__dict__.pop(name, None)

    def _observe(self, chosen: Mask, observations: Array) -> None:
        row = np.empty(self.simulation.row_size)
        self.simulation.kernel.observe_all(self._columns, self.simulation.settings, chosen, row, observations)

    def _advance(self) -> tuple[Array, Array, Mask]:
        """The compiled step: observations, rewards, [terminated, truncated]."""
        if self.num_envs <= COPIED:
            own, step = self._own_step
            team.run(step)
            observations, rewards, ends = own
            return observations.copy(), rewards.copy(), ends.copy()
        results = self._results()
        team.run(bind_all(self._steps, *results))
        return results

    def _results(self) -> tuple[Array, Array, Mask]:
        return np.empty(self._shape), np.empty(self.num_envs), np.empty((2, self.num_envs), dtype=bool)

    @cached_property
    def _own_step(self) -> tuple[tuple[Array, Array, Mask], list[Bound]]:
        """Arrays for the results, and the compiled step that writes them."""
        own = self._results()
        return own, bind_all(self._steps, *own)

    @cached_property
    def _steps(self) -> list[Bound]:
        """The compiled step of these environments, one for each thread."""
        simulation = self.simulation
        step = simulation.kernel.advance_all.bind(
            self._columns, simulation.settings, self._running, self._fresh, self._actions
        )
        return [step.bind(np.empty(simulation.kernel.WORK), *span, self._table) for span in self._spans]

    def __getstate__(self) -> dict[str, Any]:
        """A copy binds its own arrays."""
        return {name: value for name, value in self.__dict__.items() if name not in BOUND}

    def _info(self, observations: Array, terminated: Mask, ended: Mask, chosen: NDArray[np.intp]) -> dict[str, Any]:
        """What Gymnasium's vector environments make of the scalar environments' infos."""
        success = np.zeros(self.num_envs, dtype=bool)
        last = chosen[~terminated[chosen]]  # on the horizon; leaving the region is no success
        if last.size:
            rows = np.ascontiguousarray(self._columns[:, last].T)
            success[last] = self.simulation.success(rows, observations[last], terminated[last])
        info: dict[str, Any] = {"is_success": success, "_is_success": ended.copy()}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = np.full(self.num_envs, None, dtype=object)
            final[chosen] = np.fromiter(observations[chosen], dtype=object)
            info = {"final_obs": final, "_final_obs": ended.copy(), "final_info": info, "_final_info": ended.copy()}
        return info

    # -- what is asked of the arguments -------------------------------------------------------------------------------

    def _require_reset(self) -> None:
        if not self._begun:
            raise gym.error.ResetNeeded("Call reset before step.")

    def _require_running(self) -> None:
        self._require_reset()
        if self.autoreset_mode is AutoresetMode.DISABLED and self._waiting.size:
            raise gym.error.ResetNeeded(
                f"The episode of environment {self._waiting[0]} has ended: call "
                'reset(options={"reset_mask": terminated | truncated}) before step.'
            )

    def _take(self, actions: Any) -> None:
        """Copies the actions, shape (num_envs,), which must be finite wherever one counts."""
        try:
            given = np.asarray(actions)
        except ValueError:  # ragged
            given = np.array(None)
        if given.shape != self._actions_shape or given.dtype.kind not in "fiu":
            raise ValueError(
                f"`actions` must be {self.num_envs} numbers, shape ({self.num_envs}, 1), "
                f"got {actions!r} of shape {given.shape}."
            )
        self._actions[:] = given[:, 0]
        finite = np.isfinite(self._actions)
        if not finite.all():
            for i in np.flatnonzero(~finite & self._running)[:1]:
                raise ValueError(f"`actions` must be finite, got {self._actions[i]} for environment {i}.")

    def _mask(self, mask: Any) -> Mask:
        """Which environments to reset; errors as those of Gymnasium's own vector environments."""
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f'`options["reset_mask"]` must be a NumPy array of bool, got {mask!r}.')
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f'`options["reset_mask"]` must have shape ({self.num_envs},) and choose an environment, got {mask!r}.'
            )
        return mask

    def _seeds(self, seed: int | Sequence[int | None]) -> Sequence[int | None]:
        """One seed for each environment; None: it goes on with its stream."""
        seeds = seed if isinstance(seed, Sequence) else (seed,)
        for value in seeds:
            if value is not None and not (isinstance(value, int) and value >= 0):
                seeding.np_random(value)  # raises Gymnasium's own error
        if isinstance(seed, int):
            return range(seed, seed + self.num_envs)
        if len(seeds) != self.num_envs:
            raise ValueError(f"`seed` must be an integer or {self.num_envs} of them, got {len(seeds)}.")
        return seeds


def spans(num_envs: int, count: int) -> list[tuple[int, int]]:
    """At most `count` spans [start, stop) of about the same length, in multiples of the kernel's block."""
    blocks = -(-num_envs // BLOCK)
    edges = [min(num_envs, BLOCK * round(blocks * k / count)) for k in range(count + 1)]
    return [(start, stop) for start, stop in pairwise(edges) if start < stop]


def _count(name: str, value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"`{name}` must be an integer >= 1, got {value!r}.")
    return value
