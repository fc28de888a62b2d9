"""Reproduce the example of the paper: the four-panel figure from the exact solution, reference values beside computed ones.

    python scripts/reproduce_paper.py --out results/paper
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import baselines
import mfc_gym  # noqa: F401 (registers the environments)
from baselines import evaluation, figures
from baselines.exact_metrics import exact_metrics, total_variation
from baselines.filippov import ExactSolution

START = (0.5, 0.0, 0.0)
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "A  MFC, the paper's gain, Q = I": ("mfc", {"gain": "paper", "design": "paper"}),
    "B  MFC, the theorem's gain, Q = I": ("mfc", {"gain": "theorem", "design": "paper"}),
    "C  matched only, Q = I": ("matched-only", {"design": "paper"}),
    "D  MFC, the paper's gain, surface (s + 4)^2": ("mfc", {"gain": "paper", "design": "surface"}),
}
# independent values: an event-driven solution of the same equations by another implementation, docs/reference_values.md
EXPECTED: dict[str, tuple[float, float, float, float, float, float]] = {
    "A": (-0.1553075186, -0.0089366078, -0.0017688052, 2.0452315041, 0.7942604718, 100.6591416),
    "B": (np.nan, -0.0056993467, -0.0006874170, 2.0094570524, 0.7929102170, 101.96287),
    "C": (-0.2672038249, -0.2914836460, 0.3433098900, 5.4230064, 1.9754230, 219.397),
    "D": (-0.1398123566, -0.0036092944, -6.379e-7, 1.9554775560, 0.7798543210, 206.1238),
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
    return {
        label: baselines.filippov(env, baselines.make(name, env, switching="sign", initial_model_state=START, **options))  # type: ignore[arg-type]
        for label, (name, options) in CASES.items()
    }


def values_table(solutions: dict[str, ExactSolution], metrics: dict[str, dict[str, float]]) -> Table:
    """Computed values with the reference values below each."""
    table = Table(title="The paper's example: exact solutions, and independent reference values below")
    for name in ("case", "modes", "e(5)", "e(10)", "e(20)", "IAE", "ISE", "int u^2", "variation of u", "max |u|"):
        table.add_column(name, justify="left" if name in ("case", "modes") else "right")
    for label, exact in solutions.items():
        e, m = exact.signals(np.array([5.0, 10.0, 20.0]))["error"], metrics[label]
        modes = "".join({1: "+", -1: "-", 0: "0"}[mode] for mode in exact.modes)
        table.add_row(label, modes, *(f"{v:.8g}" for v in (*e, m["iae"], m["ise"], m["energy"], m["total_variation"], m["peak"])))
        expected = EXPECTED[label[0]]
        table.add_row("   reference", "", *("-" if np.isnan(v) else f"{v:.8g}" for v in expected), "", "", end_section=True)
    return table


def sampled() -> dict[str, list[tuple[float, float, float]]]:
    """(dt, max abs(y - y_exact), variation of u per second in the tail) of each switching law and design."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for dt in DTS:
        env = gym.make("mfc_gym/PerturbedChain-v0", dt=dt)
        for design in ("paper", "surface"):
            options: dict[str, Any] = {"design": design, "gain": "paper", "initial_model_state": START}
            exact = baselines.filippov(env, baselines.make("mfc", env, switching="sign", **options))  # type: ignore[arg-type]
            for switching in SWITCHINGS:
                t = baselines.rollout(env, baselines.make("mfc", env, switching=switching, **options))
                error = np.abs(t.error - exact.signals(np.minimum(t.time, exact.end))["error"]).max()
                half = t.control.size // 2
                rate = np.abs(np.diff(t.control[half:])).sum() / (dt * half)
                rows.setdefault(f"{switching}, {design} P", []).append((dt, float(error), float(rate)))
    return rows


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
    figures.save(figures.sampling(rows, variation), out / "sampling.png")
    table = Table(title="The law in sampled time: max |y - y_exact| / variation of u per second in the tail")
    table.add_column("switching law, design")
    for dt in DTS:
        table.add_column(f"{1e3 * dt:g} ms", justify="right")
    for label, points in rows.items():
        table.add_row(label, *(f"{error:.1e} / {rate:.3g}" for _, error, rate in points))
    table.add_row("exact solution", *(f"0 / {variation:.3g}" for _ in DTS))
    console.print(table)
    values = {label: {"switching_times": list(solutions[label].switching_times), **metrics[label]} for label in labels}
    evaluation.write_json(out / "values.json", {"exact": values, "sampled": rows})
    console.print(f"Written: {out / 'figure.png'}, {out / 'sampling.png'}, {out / 'values.json'}")


def run() -> None:
    """The command line."""
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except ValueError as error:
        Console(stderr=True, soft_wrap=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        sys.exit(2)


if __name__ == "__main__":
    run()
