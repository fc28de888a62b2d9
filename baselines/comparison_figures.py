"""Figures of a comparison, from its data: policies by colour and marker, both safe for the colour-blind."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from baselines import figures
from baselines.comparison_text import by_label, trainings
from baselines.comparison_text import number as shown
from baselines.evaluation import Result

Data = dict[str, Any]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C8C8C")  # Okabe and Ito
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
INK = "#1b1f23"  # text and axes; a page replaces it by its own colour


def plain(label: str) -> str:
    """A label that Matplotlib neither takes for mathematics nor hides from a legend."""
    text = "".join(c if c.isprintable() else " " for c in label).replace("$", r"\$")
    short = text if len(text) <= 40 else f"{text[:39]}…"
    return f" {short}" if short.startswith("_") else short


def intervals(data: Data, part: Callable[[Data], Data | None], label: str, log: bool) -> Figure:
    """One row for each shift, one point with its interval for each policy; `part` finds the estimate."""
    count = len(data["shifts"])
    figure, ax = _axes(6.2, 1.3 + 0.42 * count)
    finite = [v for s in data["shifts"] for p in s["policies"] for v in _values(part(p)) if v is not None]
    edge = max(finite, default=1.0) * (2.0 if log else 1.0)
    for k, policy in enumerate(data["policies"]):
        offset = 0.5 * (k + 0.5) / len(data["policies"]) - 0.25
        found = [part(by_label(shift)[policy["label"]]) for shift in data["shifts"]]
        rows = [(i + offset, one) for i, one in enumerate(found) if one is not None]
        for j, (y, one) in enumerate(rows):
            _point(ax, y, one, edge, k, plain(policy["label"]) if j == 0 else None)
    if log:
        ax.set_xscale("log")
    ax.set_yticks(range(count), [shift["title"] for shift in data["shifts"]])
    ax.set_ylim(count - 0.5, -0.5)
    ax.set_xlabel(label)
    figures.legend(figure, most=3)
    return figure


def tail(data: Data) -> Figure:
    """Median tail RMS of every policy under every shift."""
    return intervals(data, lambda p: p["metrics"]["tail_rms"]["median"], "median tail RMS of y - y_d", True)


def improvement(data: Data) -> Figure:
    """Probability that a policy's tail RMS is smaller than the reference policy's on the same episode."""

    def part(policy: Data) -> Data | None:
        return policy["against"] and policy["against"]["tail_rms"]["improvement"]

    label = f"probability of a smaller tail error than {plain(data['reference'])}"
    figure = intervals(data, part, label, False)
    (ax,) = figure.axes
    ax.axvline(0.5, color="k", linewidth=1.2, linestyle=":")
    ax.set_xlim(-0.03, 1.03)
    return figure


def profiles(data: Data) -> Figure:
    """Fraction of the episodes below a tail RMS, with bands: one panel for each shift."""
    columns = min(3, len(data["shifts"]))
    rows = -(-len(data["shifts"]) // columns)
    figure = Figure(figsize=(2.9 * columns + 0.3, 2.1 * rows + 0.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns, sharey=True)).ravel()
    for ax, shift in zip(panels, data["shifts"], strict=False):
        ax.grid(alpha=0.25)
        for k, policy in enumerate(shift["policies"]):
            found, colour = policy["profile"], COLOURS[k % len(COLOURS)]
            ax.fill_between(shift["tau"], found["low"], found["high"], color=colour, alpha=0.25, linewidth=0)
            name = plain(policy["label"]) if ax is panels[0] else None
            ax.semilogx(shift["tau"], found["value"], colour, linestyle=_line(k), linewidth=1.4, label=name)
        ax.set_title(shift["title"], fontsize="small")
        ax.set_ylim(0, 1.02)
        few_labels(ax, shift["tau"][0], shift["tau"][-1])
    for ax in panels[len(data["shifts"]) :]:
        ax.set_axis_off()
    figure.supxlabel("tail RMS of y - y_d", fontsize="medium")
    figure.supylabel("fraction of the episodes below", fontsize="medium")
    figures.legend(figure)
    return figure


def few_labels(ax: Axes, low: float, high: float) -> None:
    """At most four labels on a logarithmic axis: decades, and where there is hardly one also 3 times these."""
    subs = (1.0,) if high / low > 30 else (1.0, 3.0)
    ax.xaxis.set_major_locator(LogLocator(subs=subs, numticks=4))
    ax.xaxis.set_major_formatter(LogFormatterSciNotation(labelOnlyBase=False, minor_thresholds=(np.inf, np.inf)))
    ax.xaxis.set_minor_formatter(NullFormatter())


def learning(data: Data) -> Figure:
    """Median tail RMS over timesteps, interquartile mean over the trainings; dashed: the reference policy."""
    figure, ax = _axes(6.2, 3.4)
    labels, highest = [policy["label"] for policy in data["policies"]], 1e-12
    for one in data["learning"]["curves"]:
        k = labels.index(one["label"])
        colour = COLOURS[k % len(COLOURS)]
        low, value, high = (np.array([np.nan if v is None else v for v in one[p]]) for p in ("low", "value", "high"))
        highest = max([highest, *value[np.isfinite(value)]])
        steps, top = np.array(one["timesteps"]) / 1e6, np.where(np.isnan(high), 1e3, high)
        ax.fill_between(steps, low, top, color=colour, alpha=0.25, linewidth=0)
        name = f"{plain(one['label'])}, {trainings(one['trainings'])}"
        ax.plot(steps, value, colour, marker=MARKERS[k % len(MARKERS)], markersize=3, linewidth=1.4, label=name)
    level = data["learning"]["level"]
    if level is not None:
        ax.axhline(level, color=INK, linestyle="--", linewidth=1, label=f"{plain(data['reference'])}: {shown(level)}")
    ax.set_yscale("log")
    ax.set_ylim(top=2 * highest)
    ax.set_xlabel("million timesteps")
    ax.set_ylabel("median tail RMS")
    ax.legend(frameon=False)
    return figure


def episode(results: Sequence[Result]) -> Figure:
    """One episode of every policy, in the policies' own colours."""
    with matplotlib.rc_context({"axes.prop_cycle": cycler(color=COLOURS)}):
        named = [replace(one, entry=replace(one.entry, label=plain(one.entry.label))) for one in results]
        return figures.episode(named)


def ink(figure: Figure) -> Figure:
    """The same figure with text, axes and black lines in `INK`."""
    legends = [*figure.legends, *filter(None, (ax.get_legend() for ax in figure.axes))]
    texts = [text for legend in legends for text in legend.get_texts()]
    for ax in figure.axes:
        ax.tick_params(colors=INK, which="both", labelsize="small")
        ax.spines[["top", "right"]].set_visible(False)
        for spine in ax.spines.values():
            spine.set_color(INK)
        for line in ax.lines:
            if line.get_color() == "k":
                line.set_color(INK)
        texts += [ax.title, ax.xaxis.label, ax.yaxis.label]
    for legend in legends:
        legend.get_frame().set_visible(False)
    for text in [*texts, *figure.texts]:
        text.set_color(INK)
    return figure


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    ax = figure.subplots()
    ax.grid(alpha=0.25)
    ax.set_axisbelow(True)
    return figure, ax


def _line(k: int) -> str:
    return ("-", "--", "-.", ":")[k % 4]


def _values(estimate: Data | None) -> list[float | None]:
    return [] if estimate is None else list(estimate.values())


def _point(ax: Axes, y: float, estimate: Data, edge: float, k: int, label: str | None) -> None:
    """A point with its interval; what is infinite ends in an arrow at the edge."""
    value, low, high = (edge if v is None else v for v in (estimate["value"], estimate["low"], estimate["high"]))
    colour, infinite = COLOURS[k % len(COLOURS)], estimate["value"] is None
    ax.plot([low, high], [y, y], color=colour, linewidth=2, solid_capstyle="butt")
    if estimate["high"] is None:
        ax.annotate("∞", (edge, y), color=colour, ha="left", va="center", xytext=(5, 0), textcoords="offset points")
    marker = ">" if infinite else MARKERS[k % len(MARKERS)]
    ax.plot([value], [y], color=colour, marker=marker, markersize=5.5, linestyle="none", label=label)
