"""How a training begins and what it acts through: one table, by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from baselines.hyperparameters import Hyperparameters
from baselines.training_env import Terms


@dataclass(frozen=True)
class Mode:
    """What differs from the plain training of an algorithm."""

    corrects: bool = False  # the network's output is a correction of the base controller's action
    clones: bool = False  # the actor first imitates the base controller
    critic_first: int = (
        0  # timesteps for which the actor stays as it is: a critic that knows nothing would spoil a clone
    )
    terms: Terms = Terms()  # noqa: RUF009 (frozen)
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # fields of Hyperparameters, by algorithm

    def applied(self, algorithm: str, given: Hyperparameters) -> Hyperparameters:
        """The hyperparameters with this mode's changes."""
        return replace(given, **self.changes.get(algorithm, {}))


MODES: dict[str, Mode] = {
    "direct": Mode(),
    "residual": Mode(
        corrects=True,
        terms=Terms(fineness=20.0, output=0.001),
        changes={"ppo": {"log_std": (-0.5, -1.2), "learning_rate": 5e-4}},
    ),
    "imitation": Mode(clones=True, critic_first=131_072, terms=Terms(fineness=20.0)),
}
