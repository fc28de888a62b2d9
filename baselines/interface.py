"""What stands between an environment and a network: the same for a learner and for what it leaves behind."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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

    observer: Observer = Observer()  # noqa: RUF009 (frozen)
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

    def see(self, observations: Array, memory: Array, fresh: NDArray[np.bool_]) -> tuple[Array, "Held"]:
        """(signals (N, s), what the actions start from) of observations (N, d); `memory` as in `Controller.control`.

        The signals are the observer's and, last, the base's action. Raises ValueError for a base made for no environment.
        """
        own = self.observer.memory_size(observations.shape[1])
        signals = self.observer.see(observations, memory[:, :own], fresh)
        if self.base is None:
            return signals, Held(np.zeros(len(signals)), np.ones(len(signals)))
        if self.controller is None:
            raise ValueError(f"`made_for(env)` must come before `predict`, {self.base.controller} is made for none.")
        remembered = np.ascontiguousarray(memory[:, own:])
        u = self.controller.control(np.ascontiguousarray(observations), remembered, fresh)
        memory[:, own:] = remembered
        held = Held(u / self.controller.nominal.input_limit, self.base.reach(observations))
        return np.hstack([signals, held.action[:, None]]), held

    def act(self, outputs: Array, held: "Held", memory: Array) -> Array:
        """Actions (N, 1) of the network's outputs (N, 1) and what they start from; the memory takes them up."""
        actions = np.clip(held.action + held.reach * outputs[:, 0], -1.0, 1.0)
        self.observer.acted(actions, memory)
        return actions[:, None]


class Held(NamedTuple):
    """action + reach * output is what the plant gets."""

    action: Array  # (N,), the base's; 0 without one
    reach: Array  # (N,), 1 without a base
