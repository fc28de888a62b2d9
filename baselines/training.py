"""Training in segments: learn, evaluate against the reference policy, checkpoint. What is interrupted resumes without a gap."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from baselines import checkpoint, learner
from baselines.agent_files import save_agent
from baselines.hyperparameters import Hyperparameters, hyperparameters
from baselines.policy_network import Agent, Features
from baselines.provenance import provenance
from baselines.sb3_weights import agent_of
from baselines.training_env import SCALING, features
from baselines.validation import Evaluation, Row

VALIDATION = 2**30  # first seed, between SCALING and `learner.TRAINING`; those below all three are left for tests
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

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The table's entry for the algorithm on the plant."""
        return hyperparameters(self.algorithm, self.env)


class Training:
    """A model with what it has learnt so far: the curve, one row for each evaluation, and the best agent."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.features: Features = features(plan.env, plan.options, SCALING)
        self.evaluation = Evaluation(plan.env, plan.options, plan.episodes, VALIDATION)
        given, seen, task = plan.hyperparameters, self.features, self.evaluation.simulation
        options = {**plan.options, "horizon": max(1, round(given.episode * task.steps)) * task.dt}
        self.model = learner.build(plan.algorithm, plan.env, options, given, seen, plan.seed)
        self.curve: list[Row] = []
        self.best: Agent | None = None

    @property
    def over(self) -> bool:
        """Whether all timesteps are done, or the best evaluation is `patience` evaluations ago."""
        returns, patience = [row["return"] for row in self.curve], self.plan.patience
        stale = patience is not None and len(returns) - returns.index(max(returns)) > patience if returns else False
        return stale or self.model.num_timesteps >= self.plan.timesteps

    def segment(self, progress: Callable[[int], object]) -> Row:
        """Learn for one segment and evaluate; returns the new row of the curve."""
        plan, model = self.plan, self.model
        before, begin = self.curve[-1]["seconds"] if self.curve else 0.0, time.perf_counter()
        learner.begin_segment(model, plan.hyperparameters, plan.seed, plan.timesteps)
        length = min(plan.hyperparameters.segment, plan.timesteps - model.num_timesteps)
        model.learn(length, Listener(progress), log_interval=10, reset_num_timesteps=False)
        found = self.evaluation(self.agent())
        seconds = before + time.perf_counter() - begin
        self.curve.append({"timesteps": model.num_timesteps, "seconds": seconds, **found})
        if found["return"] == max(row["return"] for row in self.curve):
            self.best = self.agent()
        self._log(found)
        return self.curve[-1]

    def agent(self) -> Agent:
        """The agent as it is, with where it comes from."""
        training = {
            "seed": self.plan.seed,
            "timesteps": self.model.num_timesteps,
            "hyperparameters": asdict(self.plan.hyperparameters),
            "curve": list(self.curve),
            "reference": self.evaluation.reference,
            **provenance(),
        }
        environment = {"id": self.plan.env, "options": dict(self.plan.options)}
        return agent_of(self.model, self.features, environment, training)

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
        if differing := sorted(k for k, v in asdict(self.plan).items() if further["plan"][k] != v):
            raise ValueError(f"`resume` must be given the arguments of the training in {out}, got other {differing}.")
        self.curve, best, now = further["curve"], further["best"], self.agent()
        layers = tuple((weight.numpy(), bias.numpy()) for weight, bias in best["layers"])
        self.best = Agent(
            now.algorithm, now.features, layers, now.activation, now.output, now.environment, best["training"]
        )
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
    Raises ValueError if `out` holds a training and `resume` is False, or another training than this plan's.
    """
    begun = (out / CHECKPOINT).exists()
    if begun and not resume:
        raise ValueError(f"`out` must not hold a training unless `resume` is given, got {out}.")
    training = Training(plan)
    if begun:
        training.resume(out)
    training.model.set_logger(Logger(str(out), [TensorBoardOutputFormat(str(out / "tensorboard"))]))
    while not training.over:
        row = training.segment(progress)
        training.save(out)
        report(row, training.evaluation.reference)
    training.model.logger.close()
    return training
