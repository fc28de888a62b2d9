"""Record episodes of a policy as a Minari dataset.

python scripts/record_episodes.py mfc --episodes 100 --dataset mfc_gym/chain/mfc-v0 --out results/datasets
MINARI_DATASETS_PATH=results/datasets python -c "import mfc_gym, minari; minari.load_dataset('mfc_gym/chain/mfc-v0')"
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, evaluation, task_id


@dataclass(frozen=True)
class Arguments:
    """Record episodes of a policy."""

    policy: Annotated[str, tyro.conf.Positional]
    """A controller with its options as in evaluate_controller, or an agent as algorithm:folder"""
    env: str = "mfc_gym/PerturbedChain-v0"
    """Environment id, or a plant file ending in .toml"""
    dataset: str = "mfc_gym/chain/mfc-v0"
    """Id of the dataset"""
    scenario: str = "random"
    """Theta, initial state and reference drawn at random ("random"), or the plant's own fixed episode ("paper")"""
    dt: float | None = 0.02
    """Sampling time in s"""
    horizon: float | None = 10.0
    """Length of an episode in s"""
    derivatives: str | None = None
    """How xi_n is obtained: exact, or by a differentiator on the sampled output (ired, hdd, ired-linear, high-gain, dirty)"""
    noise: float | None = None
    """Amplitude of uniform noise on the output (with a differentiator)"""
    episodes: int = 100
    """Number of episodes"""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i"""
    out: Path | None = None
    """Folder of the datasets; left out: MINARI_DATASETS_PATH or ~/.minari/datasets"""


def main(args: Arguments) -> None:
    """Record. Raises ValueError for arguments that cannot work, before anything is written."""
    from baselines import demonstrations  # here, so that --help works without Minari

    for name, value, least in (("episodes", args.episodes, 1), ("seed", args.seed, 0)):
        if value < least:
            raise ValueError(f"`{name}` must be at least {least}, got {value}.")
    names = ("scenario", "dt", "horizon", "derivatives")
    options: dict[str, Any] = {name: value for name in names if (value := getattr(args, name)) is not None}
    if args.noise is not None:
        options["sensors"] = {"noise": args.noise}
    env, console = task_id.make(args.env, options), Console(soft_wrap=True)
    entry = evaluation.entry(args.policy, env)
    folder = None if args.out is None else evaluation.writable(args.out).resolve()
    columns = (*Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        step = partial(bar.advance, bar.add_task(entry.label, total=args.episodes))
        seeds = range(args.seed, args.seed + args.episodes)
        made = demonstrations.write(args.dataset, env, entry.policy, args.policy, seeds, folder, step)
    console.print(f"Written: {args.dataset}, {made.total_episodes} episodes, {made.total_steps} steps")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
