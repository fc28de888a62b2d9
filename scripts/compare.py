"""Compare controllers and trained agents on the same episodes, in distribution and out of it: tables, figures, one page.

python scripts/compare.py mfc matched-only "ppo:results/ppo-*/best" --episodes 256 --out results/comparison
python scripts/compare.py mfc "PPO=ppo:results/a/best,results/b/best" --shifts noise slower
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn
from rich.text import Text

import mfc_gym  # noqa: F401 (registers the environments)
from baselines import (
    command_line,
    comparison,
    comparison_data,
    comparison_figures,
    comparison_text,
    figures,
    files,
    shifts,
    tables,
)
from baselines.comparison import MEASURES, Played, Policy
from baselines.comparison_data import Contest
from baselines.comparison_page import Picture, page
from baselines.comparison_summary import Bootstrap
from baselines.evaluation import Result, writable
from baselines.provenance import provenance


@dataclass(frozen=True)
class Arguments:
    """Compare policies on the same episodes."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Controllers by name, with options as mfc:gain=paper; agents as algorithm:folders, where several folders (commas, or *
    in quotes) are the trainings of one column; label=... in front names the column"""
    env: str = "mfc_gym/PerturbedChain-v0"
    """Environment id, or a plant file ending in .toml"""
    against: str | None = None
    """Label of the reference policy; left out: the first one"""
    shifts: tuple[str, ...] = ()
    """Names of the shifts beside the task itself (see baselines/shifts.py); left out: all"""
    scenario: str = "random"
    """Theta, initial state and reference drawn at random ("random"), or the plant's own fixed episode ("paper")"""
    reference: str | None = None
    """Name of the reference trajectory; left out: the plant's own"""
    dt: float | None = 0.02
    """Sampling time in s"""
    horizon: float | None = 10.0
    """Length of an episode in s"""
    input_limit: float | None = None
    """Bound of the input"""
    order: int | None = None
    """Order of the plant, where it has this option"""
    episodes: int = 256
    """Number of episodes of each run under each shift"""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i, for every policy and shift"""
    reps: int = 1000
    """Resamples of the bootstrap"""
    out: Path = Path("results/comparison")
    """Folder for the page, the tables, the data and the figures"""


def options(args: Arguments) -> dict[str, Any]:
    """The environment's keywords in distribution."""
    names = ("scenario", "reference", "dt", "horizon", "input_limit", "order")
    return {name: value for name in names if (value := getattr(args, name)) is not None}


def play(args: Arguments, policies: list[Policy], against: str, bar: Progress) -> Contest:
    """Every policy under every shift."""
    settings = comparison.settings(args.env, options(args), shifts.chosen(args.shifts))
    for policy in policies:  # one that does not fit is found before the first episode
        comparison.entries(policy, settings[shifts.IN_DISTRIBUTION])
    seeds = range(args.seed, args.seed + args.episodes)
    task = bar.add_task("episodes", total=len(settings) * sum(len(policy.specifications) for policy in policies))
    played: dict[str, Mapping[str, Played]] = {}
    zero = {}
    for name, setting in settings.items():
        bar.update(task, description=setting.shift.title)
        step = partial(bar.advance, task)
        played[name] = {policy.label: comparison.play(policy, setting, seeds, step) for policy in policies}
        zero[name] = {k: v[None] for k, v in setting.scores(comparison.ZeroInput(), seeds)[0].items()}
    bar.update(task, description="episodes")
    environment = {"id": args.env, "options": options(args)}
    return Contest(environment, seeds, policies, against, {k: s.shift for k, s in settings.items()}, played, zero)


def pictures(data: dict[str, Any], contest: Contest) -> list[Picture]:
    """All figures there is something to show in."""
    first = contest.played[shifts.IN_DISTRIBUTION]
    results = [Result(replace(one.entries[0], label=label), [], one.first) for label, one in first.items()]
    band = "Bands and bars: 95 % bootstrap intervals."
    found = [
        ("tail", "Accuracy under every shift", f"To the left is better. {band}", comparison_figures.tail(data)),
        (
            "profiles",
            "Performance profiles",
            f"To the left and above is better; a line that stays below 1 left the region. {band}",
            comparison_figures.profiles(data),
        ),
        (
            "episode",
            "One episode in distribution",
            f"The episode of seed {contest.seeds.start}; of several trainings the first one.",
            comparison_figures.episode(results),
        ),
    ]
    if len(contest.policies) > 1:
        caption = f"To the right of the dotted line the policy wins on most episodes. {band}"
        drawn = comparison_figures.improvement(data)
        found.insert(1, ("improvement", "Who wins on the same episode", caption, drawn))
    if data["learning"]["curves"]:
        caption = f"On the episodes of the evaluations during training. {band}"
        found.append(("learning", "Sample efficiency", caption, comparison_figures.learning(data)))
    return [Picture(*one[:3], comparison_figures.ink(one[3]), one[0] == "profiles") for one in found]


def write_csv(path: Path, contest: Contest) -> None:
    """One line per shift, policy, run and episode."""

    def write(target: Path) -> None:
        with target.open("w", newline="") as file:
            lines = csv.writer(file)
            lines.writerow(["shift", "policy", "run", "seed", *MEASURES])
            for shift, by_label in contest.played.items():
                for label, one in by_label.items():
                    for run, rows in enumerate(zip(*(one.scores[m] for m in MEASURES), strict=True)):
                        for seed, row in zip(contest.seeds, zip(*rows, strict=True), strict=True):
                            lines.writerow([shift, label, run, seed, *row])

    files.replace(path, write)


def show(data: dict[str, Any], console: Console) -> None:
    """The tables and what is to be said of them."""
    for one in comparison_text.tables(data):
        names = tables.Column("", [Text(name) for name, _ in one.rows])
        by_policy = zip(*(cells for _, cells in one.rows), strict=True)
        columns = [
            tables.Column(label, [tables.number("\n".join(cell.parts), cell.best) for cell in cells])
            for label, cells in zip(one.policies, by_policy, strict=True)
        ]
        title = one.title or "In distribution"
        tables.side_by_side(console, title, [names], columns, ruled=range(len(one.rows)))
    console.print(Markdown(comparison_text.words(data)))


def checked(args: Arguments) -> tuple[list[Policy], str]:
    """Policies and the label of the reference policy. Raises ValueError for arguments that cannot work."""
    for name, value, least in (("episodes", args.episodes, 1), ("reps", args.reps, 1), ("seed", args.seed, 0)):
        if value < least:
            raise ValueError(f"`{name}` must be at least {least}, got {value}.")
    if args.seed + args.episodes > comparison.HELD_OUT:
        raise ValueError(f"`seed` must leave the seeds from 2^29 on to training, got {args.seed}.")
    policies = comparison.policies(args.policies)
    labels = [policy.label for policy in policies]
    against = labels[0] if args.against is None else args.against
    if against not in labels:
        raise ValueError(f"`against` must be one of the policies {', '.join(labels)}, got {against}.")
    return policies, against


def main(args: Arguments) -> None:
    """Run the comparison. Raises ValueError for arguments that cannot work."""
    console = Console()
    policies, against = checked(args)
    shifts.chosen(args.shifts)
    out = writable(args.out)
    with Progress(
        *Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeRemainingColumn(), console=console
    ) as bar:
        contest = play(args, policies, against, bar)
        task: TaskID = bar.add_task("statistics", total=len(policies) * len(contest.shifts))
        data = comparison_data.data(contest, Bootstrap(args.reps), partial(bar.advance, task))
        data["provenance"] = provenance()
        drawn = pictures(data, contest)
    files.write_json(out / "results.json", data)
    write_csv(out / "scores.csv", contest)
    files.replace(out / "comparison.md", lambda path: path.write_text(comparison_text.markdown(data)))
    for picture in drawn:
        figures.save(picture.figure, out / f"{picture.name}.png")
    files.replace(out / "comparison.html", lambda path: path.write_text(page(data, drawn)))
    show(data, console)
    names = ", ".join(["comparison.html", "comparison.md", "results.json", "scores.csv"])
    console.print(f"Written to {out}: {names}, {len(drawn)} figures")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
