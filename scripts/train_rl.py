"""Train an agent and compare it with the reference policy on the way: agents, learning curve, TensorBoard.

python scripts/train_rl.py ppo --out results/ppo
python scripts/train_rl.py ppo --out results/ppo --resume
python scripts/train_rl.py ppo --mode residual --derivatives ired --noise 1e-4 --out results/residual
python scripts/evaluate_controller.py mfc ppo:results/ppo/best --scenario random --dt 0.02 --horizon 10
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, task_id
from baselines.evaluation import parse, writable
from baselines.extras import missing
from baselines.hyperparameters import FADE, HYPERPARAMETERS, hyperparameters
from baselines.residual import Base

if TYPE_CHECKING:
    from baselines.training import Plan


@dataclass(frozen=True)
class Arguments:
    """Train an agent."""

    algorithm: Annotated[str, tyro.conf.Positional]
    """Name of the algorithm: ppo, sac, td3, tqc or crossq"""
    env: str = "mfc_gym/PerturbedChain-v0"
    """Environment id, or a plant file ending in .toml"""
    timesteps: int | None = None
    """Steps of all environments together; left out: the table's"""
    seed: int = 0
    """Seed of the networks, the exploration and the training's episodes"""
    mode: str = "direct"
    """The action itself is learnt ("direct"), a bounded correction of a controller's ("residual"), or the controller is imitated
    at first ("imitation"; then `timesteps` may be 0)"""
    base: str = "mfc"
    """The controller that is corrected or imitated, with options as in evaluate_controller: mfc:margin=1.2"""
    bound: float = Base.bound
    """Largest correction, in actions"""
    fade: float = FADE
    """Errors, in standard deviations, below which the correction's bound shrinks with the error; 0: nowhere"""
    observe: tuple[str, ...] = ()
    """What is seen beside the observation and its error: integral (of the error), last-action, past:k (earlier observations);
    output-only hides x and xi_n except y"""
    scenario: str = "random"
    """Theta, initial state and reference drawn at random ("random"), or the plant's own fixed episode ("paper")"""
    reference: str | None = None
    """Name of the reference; left out: the plant's own"""
    dt: float | None = None
    """Sampling time in s; left out: the table's, 0.02 for most plants"""
    horizon: float | None = None
    """Length of an episode in s; left out: the table's, 10 for most plants"""
    input_limit: float | None = None
    """Bound of the input"""
    order: int | None = None
    """Order of the plant, where it has this option"""
    derivatives: str | None = None
    """How xi_n is obtained: exact, or by a differentiator on the sampled output (ired, hdd, ired-linear, high-gain, dirty)"""
    noise: float | None = None
    """Amplitude of uniform noise on the output (with a differentiator)"""
    effort: float | None = None
    """Weight of u^2 in the cost"""
    episodes: int = 64
    """Number of episodes of each evaluation"""
    patience: int | None = None
    """Stop after so many evaluations without a better one"""
    threads: int = 1
    """Threads of PyTorch; for small networks one is the fastest"""
    resume: bool = False
    """Go on with the training in `out`, which must hold one; give the same arguments"""
    out: Path = Path("results/training")
    """Folder for the agents `best` and `last`, the checkpoint, and TensorBoard"""


def plan(args: Arguments) -> "Plan":
    """The training the arguments describe. Raises ValueError for arguments that cannot work."""
    from baselines.modes import MODES
    from baselines.training import Plan

    if args.algorithm not in HYPERPARAMETERS:
        raise ValueError(f"`algorithm` must be one of {', '.join(HYPERPARAMETERS)}, got {args.algorithm}.")
    id, options = task_id.named(args.env)
    given = hyperparameters(args.algorithm, id)
    timesteps = given.timesteps if args.timesteps is None else args.timesteps
    if args.mode not in MODES:
        raise ValueError(f"`mode` must be one of {', '.join(MODES)}, got {args.mode}.")
    least = 0 if MODES[args.mode].clones else 1
    for name, value, low in (
        ("timesteps", timesteps, least),
        ("episodes", args.episodes, 1),
        ("threads", args.threads, 1),
    ):
        if value < low:
            raise ValueError(f"`{name}` must be at least {low}, got {value}.")
    if args.seed < 0:
        raise ValueError(f"`seed` must be at least 0, got {args.seed}.")
    if args.patience is not None and args.patience < 1:
        raise ValueError(f"`patience` must be at least 1, got {args.patience}.")
    names = ("scenario", "reference", "dt", "horizon", "input_limit", "order", "derivatives", "effort")
    options |= {**given.environment, **{name: value for name in names if (value := getattr(args, name)) is not None}}
    if args.noise is not None:
        options["sensors"] = {"noise": args.noise}
    if not (math.isfinite(args.fade) and args.fade >= 0):
        raise ValueError(f"`fade` must be finite and >= 0, got {args.fade}.")
    through = (args.mode, args.observe, Base(*parse(args.base), args.bound), args.fade)
    return Plan(args.algorithm, id, options, args.seed, timesteps, args.episodes, args.patience, *through)


def line(row: dict[str, Any]) -> str:
    """A row of the curve in words."""
    tail = "left the region" if row["tail_rms"] is None else f"{row['tail_rms']:.4f}"
    return f"return {row['return']:9.3f}   median tail RMS {tail}   escaped {row['escaped']}"


def main(args: Arguments) -> None:
    """Run the training."""
    try:  # here, so that --help works without them
        import torch

        from baselines.training import train
    except ModuleNotFoundError as error:
        raise missing(error.name, "rl") from error
    console = Console(soft_wrap=True)
    planned, out = plan(args), writable(args.out)
    torch.set_num_threads(args.threads)
    with Progress(
        *Progress.get_default_columns()[:-1],
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(elapsed_when_finished=False),
        console=console,
    ) as bar:
        task = bar.add_task(args.algorithm, total=planned.timesteps)

        def report(row: dict[str, Any], reference: dict[str, Any]) -> None:
            console.print(f"{row['timesteps']:10d}   {line(row)}   (reference {reference['return']:.3f})")

        done = train(planned, out, args.resume, lambda n: bar.update(task, completed=n), report)
    console.print(f"reference    {line(done.evaluation.reference)}")
    console.print(f"Written: {out / 'best'}, {out / 'last'}, {out / 'checkpoint.pt'}, {out / 'tensorboard'}")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
