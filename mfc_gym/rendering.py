"""Pictures of an episode, drawn without a display."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mfc_gym.simulation import Simulation

Array = NDArray[np.float64]


class Recorder:
    """Collects an episode and draws output, reference and input over time."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._observations: list[Array] = []
        self._actions: list[float] = []
        self._figure: Any = None

    def begin(self, observation: Array) -> None:
        self._observations, self._actions = [observation.copy()], []

    def add(self, observation: Array, action: float) -> None:
        self._observations.append(observation.copy())
        self._actions.append(min(max(action, -1.0), 1.0))

    def picture(self) -> NDArray[np.uint8]:
        """Shape (height, width, 3)."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        if self._figure is None:
            self._figure = Figure(figsize=(6.4, 4.8), dpi=100, layout="tight")
            self._figure.subplots(2, 1, sharex=True)
        above, below = self._figure.axes
        n, dt = self._simulation.plant.order, self._simulation.dt
        observations = np.array(self._observations) if self._observations else np.full((1, 3 * n + 1), np.nan)
        time = dt * np.arange(len(observations))
        above.clear()
        above.plot(time, observations[:, 2 * n], "k--", label="$y_d$")
        above.plot(time, observations[:, n], label="$y$")
        above.set_ylabel("output")
        above.legend(loc="upper right")
        below.clear()
        below.step(time[:-1], self._simulation.input_limit * np.array(self._actions), where="post")
        below.set_ylabel("$u$")
        below.set_xlabel("time in s")
        below.set_xlim(0.0, self._simulation.horizon)
        canvas: Any = FigureCanvasAgg(self._figure)
        canvas.draw()
        return np.array(canvas.buffer_rgba())[..., :3].copy()
