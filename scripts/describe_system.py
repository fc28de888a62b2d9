"""Describe a plant: equations, coordinates, matched and unmatched parts, uncertainty, bounds, sliding poles.

python scripts/describe_system.py mfc_gym/PerturbedChain-v0
python scripts/describe_system.py docs/plants/van_der_pol.toml
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import sympy as sp
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

import baselines
import mfc_gym  # noqa: F401 (registers the environments)
from baselines import command_line, lyapunov, task_id
from mfc_gym.enclosure import check_bounds
from mfc_gym.flat_system import FlatSystem


@dataclass(frozen=True)
class Arguments:
    """Describe a plant."""

    system: Annotated[str, tyro.conf.Positional]
    """Environment id, or a plant file ending in .toml"""
    order: int | None = None
    """Order of the plant, where it has this option"""
    unmatchedness: float | None = None
    """From 1 (the plant as it is) to 0: the same size of uncertainty enters where the input does"""
    bounds: bool = False
    """Also prove the bounds over the operating region and the theta set (takes seconds)"""


def short(expression: Any) -> str:
    """The expression with numbers of four digits."""
    return str(sp.sympify(expression).evalf(4))


def vector(expressions: Sequence[Any]) -> str:
    return "[" + ", ".join(short(e) for e in expressions) + "]"


def rows(system: FlatSystem) -> list[tuple[str, str]]:
    """(quantity, value) of everything that follows from the equations."""
    matched, unmatched = system.decomposition
    return [
        *((f"{x}'", short(f + g * sp.Symbol("u") + d)) for x, f, g, d in
          zip(system.state, system.f, system.g, system.Delta, strict=True)),
        ("y", short(system.h)),
        *((name, f"in [{low:g}, {high:g}]") for name, (low, high) in system.theta.items()),
        *((f"{x} in the region", vector(ends)) for x, ends in system.region.items()),
        ("tau", vector(system.tau)),
        ("tau_n", vector(system.tau_n)),
        ("L_f^n h", short(system.alpha)),
        ("L_g L_f^(n-1) h", short(system.beta)),
        ("Delta, matched", vector(matched)),
        ("Delta, unmatched", vector(unmatched)),
        ("phi_m", short(system.phi_m)),
        ("phi_u", vector(system.phi_u)),
        ("Delta_1", short(sp.factor(system.Delta_1))),
        ("Delta_2", short(sp.factor(system.Delta_2))),
        ("Delta_3", short(sp.factor(system.Delta_3))),
        *((name, short(bound)) for name, bound in system.bounds.items()),
    ]  # fmt: skip


CAPTION = (
    "phi_m = L_Delta L_f^(n-1) h: what of Delta enters in the input's row; phi_u = (L_Delta L_f^k h for k <= n-2, 0): what "
    "enters in the rows above it. delta_1, delta_3, delta_m bound abs of Delta_1, Delta_3, phi_m; sharp_1, sharp_3 bound "
    "abs(Delta_1) / (1 + Delta_3), abs(Delta_3) / (1 + Delta_3): the same seen through the true input gain."
)


def pole(p: complex) -> str:
    """Four digits; the imaginary rounding errors of a multiple pole are left out."""
    return f"{p.real:.4g}" if abs(p.imag) < 1e-3 * abs(p) else f"{p.real:.4g}{p.imag:+.4g}i"


def designs(env: gym.Env[Any, Any]) -> list[tuple[str, str]]:
    """Poles of the model loop, the process loop and the sliding motion of both designs."""
    found = []
    for design in ("surface", "paper"):
        controller: Any = baselines.make("mfc", env, design=design)
        for label, poles in (
            ("model", np.roots([1.0, *controller.k[::-1]])),
            ("process", np.roots([1.0, *controller.k_tilde[::-1]])),
            ("sliding", lyapunov.sliding_poles(controller.P)),
        ):
            found.append((f"{label} poles, {design} design", ", ".join(pole(p) for p in np.sort_complex(poles))))
    return found


def main(args: Arguments) -> None:
    """Print the description. Raises ValueError for a plant that breaks an assumption."""
    names = ("order", "unmatchedness")
    options: dict[str, Any] = {name: value for name in names if (value := getattr(args, name)) is not None}
    env = task_id.make(args.system, options)
    system: FlatSystem = env.unwrapped.simulation.plant.system  # type: ignore[attr-defined]
    table = Table(title=f"{system.name}, order {system.order}", show_header=False, caption=CAPTION)
    for name, value in [*rows(system), *designs(env)]:
        table.add_row(Text(name), Text(value))
    console = Console()
    console.print(table)
    if args.bounds:
        check_bounds(system)
        console.print("The bounds hold over the operating region and the admissible theta.")


def run() -> None:
    """The command line."""
    command_line.run(main, lambda: tyro.cli(Arguments, description=command_line.description(__doc__)))


if __name__ == "__main__":
    run()
