"""Training in segments: learn, evaluate against the reference policy, checkpoint. What is interrupted resumes without a gap."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from baselines import checkpoint, learner
from baselines.agent_files import save_agent
from baselines.hyperparameters import FADE, Hyperparameters, hyperparameters
from baselines.imitation import Cloning, actor, clone, record
from baselines.interface import Interface
from baselines.modes import MODES
from baselines.observer import observer
from baselines.policy_network import Agent, Features
from baselines.provenance import provenance
from baselines.residual import Base
from baselines.sb3_weights import agent_of
from baselines.training_env import SCALING, features, widths
from baselines.validation import Evaluation, Row

# first seeds, below `learner.TRAINING`; those below all are left for tests
RECORDING, VALIDATION = 2**29 + 2**28, 2**30
CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True)
class Plan:
    """What is trained, on what, and when it ends."""

    algorithm: str  # of HYPERPARAMETERS
    env: str  # id
    options: Mapping[str, Any]  # of the environment
    seed: int
    timesteps: int
    episodes: int = 64  # of each evaluation
    patience: int | None = None  # evaluations without a better one after which training ends; None: never
    mode: str = "direct"  # of MODES
    observe: tuple[str, ...] = ()  # see `baselines.observer.observer`
    base: Base = field(default_factory=Base)  # what is corrected or imitated; a mode that does neither leaves it alone
    fade: float = FADE  # 0: a correction does not fade

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The table's entry for the algorithm on the plant, with the mode's changes."""
        return MODES[self.mode].applied(self.algorithm, hyperparameters(self.algorithm, self.env))

    @property
    def interface(self) -> Interface:
        """What the learner acts through."""
        return Interface(observer(self.observe), self.base if MODES[self.mode].corrects else None)


class Training:
    """A model with what it has learnt so far: the curve, one row for each evaluation, and the best agent."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.evaluation = Evaluation(plan.env, plan.options, plan.episodes, VALIDATION)
        self.interface = plan.interface.made_for(self.evaluation.envs)
        plan.base.build(self.evaluation.simulation.nominal)  # raises
        self.features: Features = features(plan.env, plan.options, SCALING, self.interface)
        self.interface = self._fading()
        given, seen, task = plan.hyperparameters, self.features, self.evaluation.simulation
        options = {**plan.options, "horizon": max(1, round(given.episode * task.steps)) * task.dt}
        through = (self.interface, MODES[plan.mode].terms)
        self.model = learner.build(plan.algorithm, plan.env, options, given, seen, plan.seed, *through)
        self.curve: list[Row] = []
        self.best: Agent | None = None

    def _fading(self) -> Interface:
        """The interface with the plan's fade in units of the error."""
        base, n = self.interface.base, self.evaluation.simulation.plant.order
        if base is None or not self.plan.fade:
            return self.interface
        fade = tuple((self.plan.fade * widths(self.features, self.interface, n)).tolist())
        return replace(self.interface, base=replace(base, fade=fade))

    @property
    def over(self) -> bool:
        """Whether all timesteps are done, or the best evaluation is `patience` evaluations ago."""
        returns, patience = [row["return"] for row in self.curve], self.plan.patience
        stale = patience is not None and len(returns) - returns.index(max(returns)) > patience if returns else False
        return stale or (bool(returns) and self.model.num_timesteps >= self.plan.timesteps)

    def begin(self) -> Row | None:
        """Clone the controller where the mode says so; returns the curve's first row, at no timesteps, if there is one."""
        plan = self.plan
        if MODES[plan.mode].clones:
            signals, actions = record(plan.env, plan.options, plan.base, self.interface, RECORDING, Cloning())
            clone(self.model, self.features(signals), actions, plan.seed, Cloning())
        elif plan.timesteps:
            return None
        return self._row(time.perf_counter())

    def segment(self, progress: Callable[[int], object]) -> Row:
        """Learn for one segment and evaluate; returns the new row of the curve."""
        plan, model, begin = self.plan, self.model, time.perf_counter()
        learner.begin_segment(model, plan.hyperparameters, plan.seed, plan.timesteps)
        for parameter in actor(model):
            parameter.requires_grad_(model.num_timesteps >= MODES[plan.mode].critic_first)
        length = min(plan.hyperparameters.segment, plan.timesteps - model.num_timesteps)
        model.learn(length, Listener(progress), log_interval=10, reset_num_timesteps=False)
        return self._row(begin)

    def _row(self, begin: float) -> Row:
        """Evaluate: a new row of the curve, perhaps a new best agent."""
        before, found = self.curve[-1]["seconds"] if self.curve else 0.0, self.evaluation(self.agent())
        seconds = before + time.perf_counter() - begin
        self.curve.append({"timesteps": self.model.num_timesteps, "seconds": seconds, **found})
        if found["return"] == max(row["return"] for row in self.curve):
            self.best = self.agent()
        self._log(found)
        return self.curve[-1]

    def agent(self) -> Agent:
        """The agent as it is, with where it comes from."""
        training = {
            "seed": self.plan.seed,
            "timesteps": self.model.num_timesteps,
            "mode": self.plan.mode,
            "hyperparameters": asdict(self.plan.hyperparameters),
            "curve": list(self.curve),
            "reference": self.evaluation.reference,
            **provenance(),
        }
        options = {k: Path(v).name if k == "system" else v for k, v in self.plan.options.items()}
        environment = {"id": self.plan.env, "options": options}
        return agent_of(self.model, self.features, environment, training, self.interface)

    def save(self, out: Path) -> None:
        """The checkpoint first, then the agents `best` and `last`, which `resume` writes again."""
        assert self.best is not None
        out.mkdir(parents=True, exist_ok=True)
        layers = [[torch.from_numpy(array) for array in layer] for layer in self.best.layers]
        best = {"layers": layers, "training": dict(self.best.training)}
        checkpoint.save(out / CHECKPOINT, self.model, {"plan": asdict(self.plan), "curve": self.curve, "best": best})
        save_agent(self.best, out / "best")
        save_agent(self.agent(), out / "last")

    def resume(self, out: Path) -> None:
        """Go on where `save` was last called. Raises ValueError if that was another training."""
        further = checkpoint.restore(out / CHECKPOINT, self.model)
        if differing := sorted(k for k, v in asdict(self.plan).items() if further["plan"].get(k) != v):
            raise ValueError(f"`resume` must be given the arguments of the training in {out}, got other {differing}.")
        self.curve, best = further["curve"], further["best"]
        layers = tuple((weight.numpy(), bias.numpy()) for weight, bias in best["layers"])
        self.best = replace(self.agent(), layers=layers, training=best["training"])
        self.save(out)

    def _log(self, found: Row) -> None:
        for name, value in found.items():
            if value is not None:
                self.model.logger.record(f"evaluation/{name}", value)
                self.model.logger.record(f"reference/{name}", self.evaluation.reference[name])
        self.model.logger.dump(self.model.num_timesteps)


class Listener(BaseCallback):
    """Tells a function how many timesteps are done."""

    def __init__(self, progress: Callable[[int], object]) -> None:
        super().__init__()
        self._progress = progress

    def _on_step(self) -> bool:
        self._progress(self.num_timesteps)
        return True


def train(
    plan: Plan,
    out: Path,
    resume: bool = False,
    progress: Callable[[int], object] = lambda timesteps: None,
    report: Callable[[Row, Row], object] = lambda row, reference: None,
) -> Training:
    """Train to the end of the plan: `out` gets the agents `best` and `last`, a checkpoint, and TensorBoard's events.

    `progress` hears the timesteps so far, `report` each row of the curve and the reference policy's.
    Raises ValueError if `out` holds a training and `resume` is False, or none, or another than this plan's, and it is True.
    """
    begun = (out / CHECKPOINT).exists()
    if begun and not resume:
        raise ValueError(f"`out` must not hold a training unless `resume` is given, got {out}.")
    if resume and not begun:
        raise ValueError(f"`resume` must find a training in `out`, got none in {out}.")
    training = Training(plan)
    if begun:
        training.resume(out)
    training.model.set_logger(Logger(str(out), [TensorBoardOutputFormat(str(out / "tensorboard"))]))
    row = None if begun else training.begin()
    while row or not training.over:
        row = row or training.segment(progress)
        training.save(out)
        report(row, training.evaluation.reference)
        row = None
    training.model.logger.close()
    return training
