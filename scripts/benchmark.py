"""Benchmarks, each one run, side by side.

# the reference policy in sampled time against the exact solution
python scripts/benchmark.py sampled
# environments, control laws, exact solution, start, memory, each beside its yardstick
python scripts/benchmark.py speed
"""

import sys
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

import baselines
import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, provenance
from baselines.exact_metrics import total_variation
from baselines.speed import MEASUREMENTS

ID = "mfc_gym/PerturbedChain-v0"
POLES = {"model_poles": (-1.0,) * 3, "poles": (-4.0,) * 3}
PAPER: dict[str, Any] = {"initial_model_state": (0.5, 0.0, 0.0), "gain": "paper", **POLES}
DTS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
LAWS: dict[str, dict[str, Any]] = {
    "reference policy": {},
    "rate = 1": {"rate": 1.0, "reach_time": 0.0},
    **{f"implicit, reach {t:g} s": {"switching": "implicit", "reach_time": t} for t in (0.0, 0.05)},
    "sign": {"switching": "sign"},
    **{f"saturation, width {width:g}": {"switching": "saturation", "width": width} for width in (0.01, 0.1, 1.0)},
}
MEASUREMENTS_OF_Y: dict[str, dict[str, Any]] = {
    "exact derivatives": {},
    "IRED": {"derivatives": "ired"},
    "IRED, noise 1e-4": {"derivatives": "ired", "sensors": {"noise": 1e-4}},
}


@dataclass(frozen=True)
class Sampled:
    """The law in sampled time: accuracy and variation of the control against the exact solution."""

    cases: int = 40
    """Random admissible theta and initial states in the unit ball"""
    seed: int = 0
    """Seed of these"""


@dataclass(frozen=True)
class Speed:
    """How fast: each thing beside its yardstick, medians and ratios of one run."""

    only: tuple[str, ...] = ()
    """Names of the measurements to make; left out: all"""


def deviation(
    env: gym.Env[Any, Any], options: dict[str, Any] | None = None, **law: Any
) -> tuple[float, float, float, float]:
    """(max abs(y - y_exact), tail RMS of y - y_d, variation of u per second in the tail, and the same of the exact u)."""
    controller = baselines.make("mfc", env, **law)
    exact = baselines.filippov(env, controller, options=options)
    sampled = baselines.rollout(env, controller, options=options)
    half, horizon = sampled.control.size // 2, sampled.dt * sampled.control.size
    error = np.abs(sampled.error - exact.signals(np.minimum(sampled.time, exact.end))["error"]).max()
    rates = np.abs(np.diff(sampled.control[half:])).sum(), total_variation(exact, horizon / 2, horizon)
    tail = np.sqrt(np.mean(sampled.error[half:] ** 2))
    return float(error), float(tail), float(rates[0] / (horizon / 2)), float(rates[1] / (horizon / 2))


def unit_ball(rng: np.random.Generator, n: int) -> np.ndarray:
    """A point of the unit ball, uniformly."""
    x = rng.normal(size=n)
    return np.asarray(x / np.linalg.norm(x) * rng.uniform() ** (1 / n))


def admissible(rng: np.random.Generator) -> np.ndarray:
    """theta of the chain of order 3 with abs(Delta_3) <= 0.25, uniformly."""
    while True:
        theta = rng.uniform(-0.5, 0.5, 2)
        if abs((1 + theta).prod() - 1) <= 0.25:
            return np.asarray(theta)


def accuracy(console: Console) -> None:
    """The paper's law and the designed surface over dt."""
    found = {
        (switching, design): [deviation(gym.make(ID, dt=dt), switching=switching, design=design, **PAPER) for dt in DTS]
        for design in ("paper", "surface")
        for switching in ("sign", "implicit", "implicit-observer")
    }
    for title, index in (("max |y - y_exact|", 0), ("tail RMS of y - y_d", 1), ("variation of u per second, tail", 2)):
        table = Table(title=f"{title}; the paper's plant, initial states and gain")
        table.add_column("switching, P")
        for dt in DTS:
            table.add_column(f"{1e3 * dt:g} ms", justify="right")
        for (switching, design), row in found.items():
            table.add_row(f"{switching}, {design}", *(f"{values[index]:.2g}" for values in row))
        console.print(table)


def admissible_set(args: Sampled, console: Console) -> None:
    """The worst of random theta and initial states at 10 ms, the paper's P."""
    table = Table(title=f"dt = 10 ms, the paper's P, {args.cases} admissible theta and initial states in the unit ball")
    for name in ("switching", "max |y - y_exact|, worst", "median", "variation over the exact one, worst", "median"):
        table.add_column(name, justify="right")
    env = gym.make(ID, dt=0.01)
    for switching in ("sign", "implicit-observer"):
        rng = np.random.default_rng(args.seed)
        found = []
        for _ in track(range(args.cases), switching, console=console, transient=True):
            options = {"theta": admissible(rng), "initial_state": unit_ball(rng, 3)}
            error, _, rate, exact = deviation(env, options, switching=switching, design="paper", **PAPER)
            found.append((error, rate / exact))
        values = np.array(found)
        worst, median = values.max(axis=0), np.median(values, axis=0)
        table.add_row(switching, *(f"{v:.3g}" for v in (worst[0], median[0], worst[1], median[1])))
    console.print(table)


def laws(args: Sampled, console: Console) -> None:
    """Every switching law on the reference policy's design, over how y is measured x dt x random episodes."""
    dts = (0.001, 0.01, 0.05)
    for title, options in MEASUREMENTS_OF_Y.items():
        table = Table(
            title=f"{title}, {args.cases} random episodes: median tail RMS | median variation of u per s (escapes)"
        )
        table.add_column("law")
        for dt in dts:
            table.add_column(f"{1e3 * dt:g} ms", justify="right")
        envs = [gym.make(ID, dt=dt, scenario="random", **options) for dt in dts]
        for name, law in LAWS.items():
            table.add_row(name, *(tail(env, law, args) for env in envs))
        console.print(table)


def tail(env: gym.Env[Any, Any], law: dict[str, Any], args: Sampled) -> str:
    """Median tail RMS | median variation of u per second (escapes) of one law."""
    controller = baselines.make("mfc", env, **law)
    episodes = [baselines.rollout(env, controller, seed=args.seed + i) for i in range(args.cases)]
    kept = [e for e in episodes if not e.terminated]
    if not kept:
        return "all escape"
    halves = [(e.error[e.error.size // 2 :], e.control[e.control.size // 2 :]) for e in kept]
    rms = np.median([np.sqrt(np.mean(error**2)) for error, _ in halves])
    rate = np.median([np.abs(np.diff(u)).sum() / (kept[0].dt * u.size) for _, u in halves])
    return f"{rms:.1e} | {rate:.3g}" + (f" ({len(episodes) - len(kept)})" if len(kept) < len(episodes) else "")


def speed(args: Speed, console: Console) -> None:
    """All measurements as one table."""
    if unknown := set(args.only) - set(MEASUREMENTS):
        raise ValueError(f"`only` must be among {sorted(MEASUREMENTS)}, got {sorted(unknown)}.")
    versions = ", ".join(f"{name} {version}" for name, version in provenance.versions().items())
    table = Table(title=f"{provenance.processor()}, {versions}")
    for column in ("", "value", "unit", "ratio"):
        table.add_column(column, justify="left" if column in ("", "unit") else "right")
    for name in args.only or MEASUREMENTS:
        console.print(f"measuring {name} …")  # no progress bar: its thread would be measured with it
        table.add_row(f"[bold]{name}[/bold]")
        try:
            rows = MEASUREMENTS[name]()
        except gym.error.DependencyNotInstalled as error:
            table.add_row(escape(f"left out: {error}"))
            rows = []
        for what, value, unit, ratio in rows:
            table.add_row(
                what, f"{value:,.3g}" if value < 1000 else f"{value:,.0f}", unit, f"{ratio:.2f}" if ratio else ""
            )
        table.add_section()
    console.print(table)


def main(args: Sampled | Speed) -> None:
    """Run and print. Raises ValueError for arguments that cannot work, before anything runs."""
    console = Console(width=None if sys.stdout.isatty() else 110)
    if isinstance(args, Speed):
        speed(args, console)
        return
    for name, value, least in (("cases", args.cases, 1), ("seed", args.seed, 0)):
        if value < least:
            raise ValueError(f"`{name}` must be at least {least}, got {value}.")
    accuracy(console)
    admissible_set(args, console)
    laws(args, console)


def run() -> None:
    """The command line."""
    command_line.run(
        main,
        lambda: tyro.extras.subcommand_cli_from_dict(
            {"sampled": Sampled, "speed": Speed}, description=command_line.description(__doc__)
        ),
    )


if __name__ == "__main__":
    run()
