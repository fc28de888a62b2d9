"""What stands between an environment and a network: the same for a learner and for what it leaves behind."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.controller import Controller
from baselines.observer import Observer
from baselines.residual import Base
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Interface:
    """Observations to signals, outputs of the network to actions; with the observer's memory, then the base controller's."""

    observer: Observer = Observer()
    base: Base | None = None
    controller: Controller | None = None  # the base, made for an environment

    def made_for(self, env: Any) -> "Interface":
        """The same for this environment, which tells it the nominal model and nothing else."""
        return self.built(env.unwrapped.nominal)

    def built(self, nominal: NominalModel) -> "Interface":
        """The same for this nominal model: the controller built, the sampling time its own."""
        controller = None if self.base is None else self.base.build(nominal)
        return replace(self, observer=replace(self.observer, dt=nominal.dt), controller=controller)

    @property
    def plain(self) -> bool:
        """Whether the signals are the observations and the outputs the actions."""
        return self.base is None and self.observer == Observer(dt=self.observer.dt)

    @property
    def reads(self) -> tuple[str, ...]:
        """As `baselines.controller.Controller.reads`."""
        controller = () if self.controller is None else self.controller.reads
        return tuple(dict.fromkeys((*self.observer.reads, *controller)))

    def memory_size(self, d: int) -> int:
        """Numbers of memory per episode for observations of d numbers."""
        return self.observer.memory_size(d) + (0 if self.controller is None else self.controller.memory_size)

    def size(self, d: int) -> int:
        """Numbers of the signals for observations of d numbers."""
        return self.observer.size(d) + (self.base is not None)

    def see(self, observations: Array, memory: Array, fresh: NDArray[np.bool_]) -> tuple[Array, Array]:
        """(signals (N, s), base's actions (N,)) of observations (N, d); `memory` as in `Controller.control`.

        The signals are the observer's and, last, the base's action. Raises ValueError for a base made for no environment.
        """
        own = self.observer.memory_size(observations.shape[1])
        signals = self.observer.see(observations, memory[:, :own], fresh)
        if self.base is None:
            return signals, np.zeros(len(signals))
        if self.controller is None:
            raise ValueError(f"`made_for(env)` must come before `predict`, {self.base.controller} is made for none.")
        remembered = np.ascontiguousarray(memory[:, own:])
        u = self.controller.control(np.ascontiguousarray(observations), remembered, fresh)
        memory[:, own:] = remembered
        base = u / self.controller.nominal.input_limit
        return np.hstack([signals, base[:, None]]), base

    def act(self, outputs: Array, base: Array, memory: Array) -> Array:
        """Actions (N, 1) of the network's outputs (N, 1) and the base's actions; the memory takes them up."""
        actions = outputs if self.base is None else np.clip(base[:, None] + self.base.bound * outputs, -1.0, 1.0)
        self.observer.acted(actions[:, 0], memory)
        return actions
