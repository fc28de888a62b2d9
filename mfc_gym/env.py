"""The environment: one perturbed flat plant, one episode at a time."""

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mfc_gym import observation as layout
from mfc_gym import rendering
from mfc_gym.simulation import Simulation
from mfc_gym.streams import OneStream

Array = NDArray[np.float64]


class TrackingEnv(gym.Env[Array, NDArray[np.float32]]):
    """Track y_d with y = h(x) of x' = f(x) + g(x) u + Delta(x), eq. (1) of [1], the input held over every interval dt.

    Observation: [x (n), xi_n (n), y_d ... y_d^(n) (n+1)], float64. Action: u / input_limit in [-1, 1].
    Reward: -dt min(cost, cost_max); leaving the operating region (terminated) costs cost_max for the rest of the
    horizon. The options are those of `mfc_gym.settings.Settings`; further keywords go to the plant (the chain's
    `order`, say).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"`render_mode` must be one of {self.metadata['render_modes']}, got {render_mode!r}.")
        self.simulation = Simulation.from_keywords(options)
        self.render_mode = render_mode
        self.action_space = self.simulation.action_space  # type: ignore[assignment]
        self.observation_space = self.simulation.observation_space  # type: ignore[assignment]
        self._memory = self.simulation.memory()
        self._begun = False
        self._recorder = rendering.Recorder(self.simulation) if render_mode else None

    @property
    def nominal(self) -> Any:
        """What a controller may know: `mfc_gym.nominal.NominalModel`."""
        return self.simulation.nominal

    @property
    def dt(self) -> float:
        """Sampling time, s."""
        return self.simulation.dt

    @property
    def rows(self) -> Array:
        """The episode as a batch of one, see `mfc_gym.stepping`; shape (1, row)."""
        return self._episode()[None]

    @property
    def output(self) -> float:
        """The true y = h(x) now."""
        return float(self.simulation.outputs(self.rows)[0])

    @property
    def theta(self) -> Array:
        """The true uncertain parameters now, shape (p,); setting them changes the plant at once, also within an episode."""
        return self.simulation.row_theta(self._episode()).copy()

    @theta.setter
    def theta(self, theta: Any) -> None:
        self.simulation.set_theta(self.rows, theta)

    @property
    def reference_parameters(self) -> Array:
        """The parameters of this episode's reference, shape (r,)."""
        return self.simulation.row_reference(self._episode()).copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        row = self.simulation.begin(OneStream(lambda: self.np_random), options)[0]
        self._memory[: row.size] = row
        self._begun = True
        self.simulation.kernel.first_observation(row, self.simulation.settings, self._observation)
        self._memory[: row.size] = row
        if self._recorder is not None:
            self._recorder.begin(self._observation)
        return self._observation.copy(), {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        try:
            (value,) = action.tolist()  # of an array: the fastest way to a number of Python
            if type(value) is not float or value - value != 0.0:
                value = scalar_action(action)
        except (AttributeError, TypeError, ValueError):  # something else
            value = scalar_action(action)
        try:
            reward, terminated, truncated = self._advance(value)
        except SystemError as error:
            raise ArithmeticError("The compiled step failed: its numbers are beyond what a float holds.") from error
        observation = self._observation.copy()
        if self._recorder is not None:
            self._recorder.add(observation, value)
        info: dict[str, Any] = {}
        if terminated or truncated:
            success = truncated and self.simulation.success(self.rows, observation[None], terminated)[0]
            info["is_success"] = bool(success)
        return observation, reward, terminated, truncated, info

    def render(self) -> Any:
        """The episode so far as a picture, shape (height, width, 3), uint8."""
        return None if self._recorder is None else self._recorder.picture()

    def _episode(self) -> Array:
        """The row of `mfc_gym.stepping`."""
        if not self._begun:
            raise gym.error.ResetNeeded("Call reset before step.")
        return self._memory[: self.simulation.row_size]

    @cached_property
    def _observation(self) -> Array:
        """Where the compiled step writes it."""
        return self._memory[-layout.size(self.simulation.plant.order) :]

    @cached_property
    def _advance(self) -> Callable[[float], tuple[float, bool, bool]]:
        """The compiled step: (reward, terminated, truncated) of an action."""
        self._episode()
        return self.simulation.kernel.advance_one.bind(self._memory)

    def __getstate__(self) -> dict[str, Any]:
        """Without what refers to this very memory."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_advance", "_observation")}


def scalar_action(action: Any) -> float:
    """The one number of an action of shape (1,). Raises ValueError if it is not a finite number or wrongly shaped."""
    try:
        array = np.asarray(action)
    except ValueError:  # ragged
        array = np.array(None)
    if array.shape == (1,) and array.dtype.kind in "fiu":
        value = float(array.item())
        if math.isfinite(value):
            return value
    raise ValueError(f"`action` must be one finite number, shape (1,), got {action!r}.")
