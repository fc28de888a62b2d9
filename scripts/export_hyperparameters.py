"""Write the table of hyperparameters as rl_zoo3 reads it: ppo.yml, sac.yml, td3.yml, tqc.yml, crossq.yml.

python scripts/export_hyperparameters.py --out results/rl_zoo3
python -m rl_zoo3.train --algo sac --env mfc_gym/PerturbedChain-v0 --gym-packages mfc_gym --conf-file results/rl_zoo3/sac.yml
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from baselines import command_line, rl_zoo3
from baselines.evaluation import writable
from baselines.hyperparameters import HYPERPARAMETERS


@dataclass(frozen=True)
class Arguments:
    """Write the table of hyperparameters as rl_zoo3 reads it."""

    out: Path = Path("results/rl_zoo3")
    """Folder for the files"""


def main(args: Arguments) -> None:
    """Write one file for each algorithm."""
    console, out = Console(soft_wrap=True), writable(args.out)
    for algorithm in HYPERPARAMETERS:
        path = out / f"{algorithm}.yml"
        path.write_text(rl_zoo3.to_yaml(rl_zoo3.entries(algorithm)))
        console.print(f"Written: {path}")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
