"""Figures of trajectories and of the exact solution. Matplotlib is loaded here and nowhere near a simulation."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from baselines.evaluation import Result
from baselines.files import replace
from baselines.filippov import ExactSolution

CHATTER = 10.0  # times the variation of the calmest input, from which on an input hides the others
LABEL = 60  # characters of a legend's line
Array = NDArray[np.float64]


def save(figure: Figure, path: Path) -> None:
    """Write the figure whole or not at all."""
    replace(path, lambda target: figure.savefig(target, dpi=150))


def legend(figure: Figure, handles: Sequence[Artist] | None = None, most: int = 4) -> None:
    """Above the axes, with as many columns as the width takes; long labels on several lines."""
    found = [h for ax in figure.axes for h in ax.get_legend_handles_labels()[0]] if handles is None else list(handles)
    labels = [fill(str(handle.get_label()), LABEL) for handle in found]
    for columns in range(min(most, len(found)), 0, -1):
        drawn = figure.legend(found, labels, loc="outside upper left", ncols=columns, frameon=False, fontsize="small")
        if columns == 1 or drawn.get_window_extent().width < figure.bbox.width:
            break
        drawn.remove()


def _axes(rows: int, height: float) -> tuple[Figure, NDArray[Any]]:
    figure = Figure(figsize=(7.0, height), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    for ax in axes:
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time in s")
    return figure, axes


def episode(results: Sequence[Result]) -> Figure:
    """The first episode of each policy: output over the reference, error on a logarithmic scale, input.

    What moves most is drawn below and pale, the first policy on top.
    """
    figure, (output, error, control) = _axes(3, 7.5)
    reference = max((r.first for r in results), key=lambda t: t.time.size)
    output.plot(reference.time, reference.reference[:, 0], "k--", label="$y_d$", linewidth=1)
    variations = [float(np.abs(np.diff(r.first.control)).sum()) for r in results]
    for i, (result, variation) in enumerate(zip(results, variations, strict=True)):
        t, order = result.first, 3 - i / len(results)
        output.plot(t.time, t.output_derivatives[:, 0], label=result.entry.label, linewidth=1, zorder=order)
        error.semilogy(t.time, np.maximum(np.abs(t.error), 1e-12), linewidth=1, zorder=order)
        chatters = variation > CHATTER * min(variations)
        look = {"linewidth": 0.3, "alpha": 0.4, "zorder": 1} if chatters else {"linewidth": 1, "zorder": order}
        control.step(t.time[:-1], t.control, where="post", **look)
    output.set_ylabel("$y$")
    legend(figure)
    error.set_ylabel("$|y - y_d|$")
    control.set_ylabel("$u$")
    return figure


def paper(mfc: ExactSolution, matched_only: ExactSolution) -> Figure:
    """The figure of [1], Section 6: tracking error, V, w and u, of the exact solutions.

    Blue: the law on output derivatives; orange: the law for matched uncertainty, V and w of xi_n (solid) and xi (dash-dotted).
    """
    figure, (error, V, w, u) = _axes(4, 9.0)
    for exact, colour, label in (
        (mfc, "C0", "output derivatives, eq. (28)"),
        (matched_only, "C1", "matched only, eq. (24)"),
    ):
        jumps = np.concatenate([exact.switching_times, np.nextafter(exact.switching_times, 0.0)])
        time = np.sort(np.concatenate([np.linspace(0.0, exact.end, 8001), jumps]))
        signals, P = exact.signals(time), exact.flow.controller.P
        error.plot(time, signals["error"], colour, label=label, linewidth=1.2)
        u.plot(time, signals["u"], colour, linewidth=1.0)
        lines = [("xi_n", "-")] + ([("xi", "-.")] if exact is matched_only else [])
        for name, style in lines:
            e = signals[name] - signals["xi_star"]
            V.plot(time, np.einsum("ti,ij,tj->t", e, P, e), colour, linestyle=style, linewidth=1.0)
            w.plot(time, 2.0 * e @ P[:, -1], colour, linestyle=style, linewidth=1.0)
    error.set_ylabel(r"$y - y_d$")
    own = Line2D(
        [], [], color="C1", linestyle="-.", linewidth=1.0, label=r"matched only, its own $\tilde V$ and $\tilde w$"
    )
    legend(figure, [*error.get_lines(), own])
    V.set_ylabel(r"$\tilde V$")
    w.set_ylabel(r"$\tilde w$")
    w.margins(y=0.05)
    u.set_ylabel("$u$")
    return figure


def sampling(
    rows: Mapping[str, Sequence[tuple[float, float, float]]], accuracy_label: str, exact_variation: float | None = None
) -> Figure:
    """Per law (dt in s, error, variation of u per second in the tail) over dt; dotted: the exact solution's variation."""
    figure = Figure(figsize=(7.5, 3.6 + 0.1 * len(rows)), layout="constrained")
    accuracy, variation = figure.subplots(1, 2)
    for i, (label, points) in enumerate(rows.items()):
        dt, error, rate = np.array(sorted(points)).T
        style = ("-", "--", ":")[i // 4 % 3]
        accuracy.loglog(1e3 * dt, error, f"C{i % 4}{style}o", label=label, markersize=3, linewidth=1)
        variation.loglog(1e3 * dt, rate, f"C{i % 4}{style}o", markersize=3, linewidth=1)
    if exact_variation is not None:
        variation.axhline(exact_variation, color="k", linewidth=0.8, linestyle=":", label="exact solution")
    accuracy.set_ylabel(accuracy_label)
    variation.set_ylabel("variation of $u$ per second, tail")
    for ax in (accuracy, variation):
        ax.set_xlabel("sampling time in ms")
        ax.grid(alpha=0.3, which="both")
    legend(figure)
    return figure
