"""Reproduce the paper's example: its four-panel figure from the exact solution, computed beside reference values.

python scripts/reproduce_paper.py --out results/paper
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

import baselines
import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, evaluation, figures, files, tables
from baselines.comparison_text import number
from baselines.exact_metrics import exact_metrics, total_variation
from baselines.filippov import ExactSolution

START = (0.5, 0.0, 0.0)  # xi*(0)
POLES: dict[str, Any] = {"model_poles": (-1.0,) * 3, "poles": (-4.0,) * 3}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "A  MFC, the paper's gain, Q = I": ("mfc", {"gain": "paper", "design": "paper"}),
    "B  MFC, the theorem's gain, Q = I": ("mfc", {"gain": "theorem", "design": "paper"}),
    "C  matched only, Q = I": ("matched-only", {"design": "paper"}),
    "D  MFC, the paper's gain, surface (s + 4)^2": ("mfc", {"gain": "paper", "design": "surface"}),
}
QUANTITIES = ("first switching time", "e(5)", "e(10)", "e(20)", "IAE", "ISE", "int u^2", "max |u|", "variation of u")
# another implementation's event-driven solution of the same equations, docs/reference_values.md
EXPECTED: dict[str, tuple[float, ...]] = {
    "A": (
        0.0024776786,
        -0.1553075186,
        -0.0089366078,
        -0.0017688052,
        2.0452315041,
        0.7942604718,
        100.6591416,
        43.3333,
        83.0092,
    ),
    "B": (0.0025353060, np.nan, -0.0056993467, -0.0006874170, 2.0094570524, 0.7929102170, 101.96287, 42.3333, 81.6439),
    "C": (0.0025780981, -0.2672038249, -0.2914836460, 0.3433098900, 5.4230064, 1.9754230, 219.397, 31.5, 99.93),
    "D": (0.3838028697, -0.1398123566, -0.0036092944, -6.379e-7, 1.9554775560, 0.7798543210, 206.1238, np.nan, 124.41),
}
DTS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
SWITCHINGS = ("sign", "saturation", "implicit", "implicit-observer")


@dataclass(frozen=True)
class Arguments:
    """Reproduce the paper's example."""

    out: Path = Path("results/paper")
    """Folder for the figures and values.json"""


def solve(env: gym.Env[Any, Any]) -> dict[str, ExactSolution]:
    """The exact solutions of the cases, from the paper's initial states."""
    common = {"switching": "sign", "initial_model_state": START, **POLES}
    return {
        label: baselines.filippov(env, baselines.make(name, env, **common, **options))
        for label, (name, options) in CASES.items()
    }


def values_table(solutions: dict[str, ExactSolution], metrics: dict[str, dict[str, float]]) -> Table:
    """Computed values beside the reference values."""
    table = Table(title="The paper's example, exact solutions (e = y - y_d, u the equivalent control in sliding)")
    for name in ("quantity", "computed", "reference"):
        table.add_column(name, justify="left" if name == "quantity" else "right")
    for label, exact in solutions.items():
        e, m = exact.signals(np.array([5.0, 10.0, 20.0]))["error"], metrics[label]
        modes = " ".join({1: "+", -1: "-", 0: "0"}[mode] for mode in exact.modes)
        table.add_row(f"[bold]{label}[/bold]", f"modes {modes}", "")
        computed = (exact.switching_times[0], *e, m["iae"], m["ise"], m["energy"], m["peak"], m["total_variation"])
        for i, (name, value, expected) in enumerate(zip(QUANTITIES, computed, EXPECTED[label[0]], strict=True)):
            reference = "" if np.isnan(expected) else f"{expected:.10g}"
            table.add_row(name, f"{value:.10g}", reference, end_section=i + 1 == len(QUANTITIES))
    return table


def sampled() -> dict[str, list[tuple[float, float, float]]]:
    """(dt, max abs(y - y_exact), variation of u per second in the tail) of each switching law and design."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for design in ("paper", "surface"):
        options: dict[str, Any] = {"design": design, "gain": "paper", "initial_model_state": START, **POLES}
        for switching in SWITCHINGS:
            for dt in DTS:
                env = gym.make("mfc_gym/PerturbedChain-v0", dt=dt)
                controller = baselines.make("mfc", env, switching=switching, **options)
                exact, t = baselines.filippov(env, controller), baselines.rollout(env, controller)
                error = np.abs(t.error - exact.signals(np.minimum(t.time, exact.end))["error"]).max()
                half = t.control.size // 2
                rate = np.abs(np.diff(t.control[half:])).sum() / (dt * half)
                rows.setdefault(f"{switching}, {design} P", []).append((dt, float(error), float(rate)))
    return rows


def show_sampled(rows: dict[str, list[tuple[float, float, float]]], index: int, title: str, console: Console) -> None:
    """One figure of `sampled` over the sampling time."""
    names = tables.Column("switching law, design", [Text(label) for label in rows])
    columns = [
        tables.Column(f"{1e3 * dt:g} ms", [tables.number(number(points[i][index])) for points in rows.values()])
        for i, dt in enumerate(DTS)
    ]
    tables.side_by_side(console, title, [names], columns)


def main(args: Arguments) -> None:
    """Draw and print everything."""
    console = Console()
    out = evaluation.writable(args.out)
    env = gym.make("mfc_gym/PerturbedChain-v0")
    solutions = solve(env)
    labels = list(solutions)
    metrics = {label: exact_metrics(exact) for label, exact in solutions.items()}
    figures.save(figures.paper(solutions[labels[0]], solutions[labels[2]]), out / "figure.png")
    console.print(values_table(solutions, metrics))
    rows = sampled()
    variation = total_variation(solutions[labels[0]], 10.0, 20.0) / 10.0
    figures.save(figures.sampling(rows, "max $|y - y_{exact}|$", variation), out / "sampling.png")
    show_sampled(rows, 1, "max |y - y_exact| in sampled time", console)
    show_sampled(rows, 2, f"Variation of u per second in the tail (exact solution: {variation:.3g})", console)
    values = {label: {"switching_times": list(solutions[label].switching_times), **metrics[label]} for label in labels}
    files.write_json(out / "values.json", {"exact": values, "sampled": rows})
    console.print(f"Written: {out / 'figure.png'}, {out / 'sampling.png'}, {out / 'values.json'}")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
