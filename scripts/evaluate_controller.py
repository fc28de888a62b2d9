"""Evaluate controllers on the same episodes: a table, results.json, results.csv and figures.

python scripts/evaluate_controller.py mfc single-loop matched-only
python scripts/evaluate_controller.py mfc mfc:switching=sign,design=paper --scenario random --episodes 100 --out results/random
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.text import Text

import baselines
import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, evaluation, figures, files, statistics, tables, task_id
from baselines.metrics import METRICS
from baselines.provenance import provenance

COLUMNS = (
    "tail_rms", "tail_max", "transient_rms", "rms", "iae", "ise", "itae", "settling_time", "energy",
    "tail_total_variation_rate", "variation_ratio", "saturation_time", "peak", "step_time", "escaped", "return",
)  # fmt: skip


Prepared = tuple[gym.Env[Any, Any], list[evaluation.Entry]]


@dataclass(frozen=True)
class Arguments:
    """Evaluate controllers on the same episodes."""

    controllers: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names (see baselines.names()), optionally with options: mfc:switching=sign,design=paper; agents as algorithm:folder"""
    env: str = "mfc_gym/PerturbedChain-v0"
    """Environment id, or a plant file ending in .toml"""
    scenario: str = "paper"
    """The plant's own fixed episode ("paper"), or theta, initial state and reference drawn at random ("random")"""
    reference: str | None = None
    """Name of the reference; left out: the plant's own"""
    dt: float | None = None
    """Sampling time in s"""
    horizon: float | None = None
    """Length of an episode in s"""
    input_limit: float | None = None
    """Bound of the input"""
    order: int | None = None
    """Order of the plant, where it has this option"""
    theta: tuple[float, ...] | None = None
    """Uncertain parameters, fixed in both scenarios"""
    initial_state: tuple[float, ...] | None = None
    """Initial state, fixed in both scenarios"""
    uncertainty: str | None = None
    """How far theta lies from its nominal value: nominal, mild, hard (what the bounds cover), beyond (what they do not)"""
    unmatchedness: float | None = None
    """From 1 (the plant as it is) to 0: the same size of uncertainty enters where the input does"""
    schedule: tuple[str, ...] = ()
    """Theta that move in time: alpha1:wave=step,amplitude=0.1,time=5 (waves: step, impulse, drift, sine, noise)"""
    disturbance: tuple[str, ...] = ()
    """Disturbances on the input (u) or a row of the state: x2:wave=sine,amplitude=0.2,frequency=3"""
    actuator: str | None = None
    """What the input suffers: lag=0.02,delay=1,rate=100,quantisation=0.1"""
    derivatives: str | None = None
    """How xi_n is obtained: exact, or by a differentiator on the sampled output (ired, hdd, ired-linear, high-gain, dirty)"""
    noise: float | None = None
    """Amplitude of uniform noise on the output (with a differentiator)"""
    episodes: int | None = None
    """Number of episodes; left out: 1 in the fixed scenario, 20 in the random one"""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i, for every controller"""
    exact: int = 3
    """Number of episodes for which the exact solution is computed (for the ratio of the control's variation)"""
    sweep: tuple[float, ...] = ()
    """Sampling times in s: also draws tail error and variation of the control over them (sweep.png)"""
    out: Path = Path("results/evaluation")
    """Folder for results and figures"""


def environment(args: Arguments) -> gym.Env[Any, Any]:
    """The environment the arguments describe."""
    names = (
        *("scenario", "reference", "dt", "horizon", "input_limit", "order", "theta", "initial_state", "derivatives"),
        *("uncertainty", "unmatchedness"),
    )
    options: dict[str, Any] = {name: value for name in names if (value := getattr(args, name)) is not None}
    for name in ("schedule", "disturbance"):
        if given := getattr(args, name):
            options[name] = dict(evaluation.parse(each) for each in given)
    if args.actuator is not None:
        options["actuator"] = actuator(args.actuator)
    if args.noise is not None:
        options["sensors"] = {"noise": args.noise}
    return task_id.make(args.env, options)


def actuator(text: str) -> dict[str, Any]:
    """The options of `--actuator`. Raises ValueError for text that is not option=value,..."""
    try:
        return evaluation.parse(f"actuator:{text}")[1]
    except ValueError as error:
        raise ValueError(f"`actuator` must be option=value,..., got {text!r}.") from error


def prepared(args: Arguments) -> Prepared:
    """The environment and every controller. Raises ValueError for arguments that cannot work."""
    env = environment(args)
    simulation: Any = env.unwrapped.simulation  # type: ignore[attr-defined]
    if simulation.steps < 2:
        raise ValueError(
            f"`horizon` must be at least 2 dt, got horizon = {simulation.horizon} and dt = {simulation.dt}."
        )
    return env, [evaluation.entry(specification, env) for specification in args.controllers]


def sweep(tasks: Mapping[float, Prepared], seeds: range) -> dict[str, list[tuple[float, float, float]]]:
    """Per controller (dt, median tail RMS, median variation of u per second in the tail), from what is prepared for each dt."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for dt, (env, entries) in tasks.items():
        for one in entries:
            result = evaluation.run(one, env, seeds)
            medians = (np.median(evaluation.column(result, m)) for m in ("tail_rms", "tail_total_variation_rate"))
            error, variation = (float(m) for m in medians)
            rows.setdefault(one.label, []).append((dt, error, variation))
    return rows


def seeds_of(args: Arguments) -> range:
    """One seed for each episode. Raises ValueError for counts and seeds that cannot work."""
    count = args.episodes if args.episodes is not None else (1 if args.scenario == "paper" else 20)
    for name, value, least in (("episodes", count, 1), ("seed", args.seed, 0), ("exact", args.exact, 0)):
        if value < least:
            raise ValueError(f"`{name}` must be at least {least}, got {value}.")
    return range(args.seed, args.seed + count)


CAPTION = (
    "e = y - y_d; the transient is the first half of the horizon, the tail the second. iae, ise, itae: integrals of abs(e), "
    "e^2, t abs(e). settling time: after it abs(e) stays within 2 % of the largest abs(y_d). energy: integral of u^2. "
    "variation ratio: variation of u over that of the exact solution."
)


def same(result: evaluation.Result) -> bool:
    """Whether there are several episodes and all are the first one."""
    first, *others = ([episode[metric] for metric in METRICS] for episode in result.episodes)
    return bool(others) and all(one == first for one in others)


def show(results: list[evaluation.Result], title: str, console: Console) -> None:
    """One row per metric, one column per controller; over many episodes the interquartile mean with its 95 % interval."""
    units = evaluation.units()
    names = (
        tables.Column("metric", [Text("reads"), *(Text(m.replace("_", " "), _style(m)) for m in COLUMNS)]),
        tables.Column("unit", [Text(), *(tables.number(units[m]) for m in COLUMNS)]),
    )
    tables.side_by_side(console, title, names, [_column(result) for result in results], ruled={0})
    console.print(CAPTION, style="italic")
    if all(map(same, results)):
        console.print("Nothing is random here: all episodes are the same, so there are no intervals.", style="italic")


def _column(result: evaluation.Result) -> tables.Column:
    shown = replace(result, episodes=result.episodes[:1]) if same(result) else result
    cells = [tables.number(_cell(evaluation.column(shown, m), m), bold=bool(_style(m))) for m in COLUMNS]
    return tables.Column(result.entry.label, [Text("\n".join(result.entry.reads)), *cells])


def _style(metric: str) -> str:
    return "bold" if metric == "tail_rms" else ""


def _cell(values: np.ndarray, metric: str) -> str:
    if values.size == 0:
        return "-"
    if values.size == 1:
        return f"{values[0]:.4g}"
    estimate = (
        statistics.rate(values) if metric == "escaped" else statistics.bootstrap(statistics.iqm, values, reps=2000)
    )
    return f"{estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"


def main(args: Arguments) -> None:
    """Run the comparison. Raises ValueError for arguments that cannot work, before anything is computed or written."""
    console = Console()
    if not args.controllers:
        raise ValueError(f"`controllers` must name at least one of {', '.join(baselines.names())}, got none.")
    seeds = seeds_of(args)
    env, entries = prepared(args)
    tasks = {dt: prepared(replace(args, dt=dt)) for dt in args.sweep}
    out = evaluation.writable(args.out)
    results = []
    with Progress(
        *Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeRemainingColumn(), console=console
    ) as bar:
        for one in entries:
            task = bar.add_task(one.label, total=len(seeds))
            results.append(evaluation.run(one, env, seeds, args.exact, partial(bar.advance, task)))
    data = {
        "environment": {"id": args.env, "options": env.spec.kwargs if env.spec else {}},
        "seeds": list(seeds),
        "units": evaluation.units(),
        "provenance": provenance(),
        "results": evaluation.as_data(results),
    }
    files.write_json(out / "results.json", data)
    evaluation.write_csv(out / "results.csv", results, seeds)
    figures.save(figures.episode(results), out / "episode.png")
    if args.sweep:
        figures.save(figures.sampling(sweep(tasks, seeds), "tail RMS of $y - y_d$"), out / "sweep.png")
    show(results, f"{args.env}, scenario {args.scenario}, {len(seeds)} episode{'s' if len(seeds) > 1 else ''}", console)
    console.print(f"Written to {out}: results.json, results.csv, episode.png{', sweep.png' if args.sweep else ''}")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
