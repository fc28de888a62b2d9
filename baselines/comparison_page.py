"""A comparison as one self-contained HTML page: no script, nothing from the network, every text escaped."""

import base64
import io
import re
from dataclasses import dataclass
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from baselines import comparison_text as text
from baselines.comparison_figures import COLOURS, INK
from baselines.comparison_text import by_label, in_distribution

Data = dict[str, Any]

TEMPLATE = "comparison.html"
STYLE = "<style>svg{color:#1b1f23}@media(prefers-color-scheme:dark){svg{color:#e4e7eb}}</style>"
OPEN = ("tail_rms", "transient_iae")  # tables that are not folded away


@dataclass(frozen=True)
class Picture:
    """A figure with its place in the page."""

    name: str  # of the file, without its ending
    title: str
    caption: str
    figure: Figure
    wide: bool = False

    @property
    def source(self) -> Markup:
        """The figure as an image within the page, in the colours of the page; an image runs no script."""
        with matplotlib.rc_context({"svg.hashsalt": self.name, "svg.fonttype": "path"}):
            buffer = io.BytesIO()
            self.figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
        svg = buffer.getvalue().decode().replace(INK, "currentColor")
        svg = re.sub(r"(<svg [^>]*>)", lambda found: found[0] + STYLE, svg, count=1)
        return Markup("data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode())


def page(data: Data, pictures: list[Picture]) -> str:
    """The page as text."""
    environment = Environment(
        loader=PackageLoader("baselines", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    every = _statistics(data)
    return environment.get_template(TEMPLATE).render(
        data=data,
        title=text.title(data),
        headline=text.headline(data),
        cards=_cards(data),
        columns=len(data["policies"]),
        facts=_facts(data),
        first=[row for row in every if row["metric"] == text.METRICS["tail_rms"] or row["main"]],
        rest=[row for row in every if row["metric"] != text.METRICS["tail_rms"]],
        tables=[_table(data, metric, title) for metric, title in text.METRICS.items()],
        pictures=pictures,
        legend=" ".join(filter(None, [text.copies(data), text.LEGEND])),
    )


def _cards(data: Data) -> list[Data]:
    """One for each policy."""
    here, scores = by_label(in_distribution(data)), {}
    if data["scores"] is not None:
        scores = {one["label"]: one["mean"] for one in data["scores"]["policies"]}
    return [
        {
            "policy": policy,
            "colour": COLOURS[k % len(COLOURS)],
            "is_reference": policy["label"] == data["reference"],
            "tail": _cell(here[policy["label"]], "tail_rms"),
            "return": _cell(here[policy["label"]], "return"),
            "escaped": here[policy["label"]]["metrics"]["escaped"],
            "score": _score(scores.get(policy["label"])),
        }
        for k, policy in enumerate(data["policies"])
    ]


def _score(estimate: Data | None) -> str | None:
    """Three decimals: next to the zero input all that work are close to 1."""
    return None if estimate is None else "-∞" if estimate["value"] is None else f"{estimate['value']:.3f}"


def _facts(data: Data) -> list[tuple[str, str]]:
    """Where all of it comes from, name and value."""
    seeds, source, bootstrap = data["seeds"], data["provenance"], data["bootstrap"]
    options = ", ".join(f"{k} = {v}" for k, v in data["environment"]["options"].items())
    return [
        ("command", " ".join(source["command"])),
        ("environment", f"{data['environment']['id']}, {options}"),
        ("seeds of the episodes", f"{seeds['first']} to {seeds['first'] + seeds['episodes'] - 1}"),
        ("bootstrap", f"{bootstrap['reps']} resamples, seed {bootstrap['seed']}, level {bootstrap['level']}"),
        ("commit", source["commit"] or "not from a checkout"),
        ("machine", source["machine"]),
        ("versions", ", ".join(f"{k} {v}" for k, v in source["versions"].items())),
    ]


def _statistics(data: Data) -> list[Data]:
    """In distribution every statistic of every metric, one row each."""
    here = in_distribution(data)["policies"]
    rows = []
    for metric, name in text.METRICS.items():
        for statistic, words in text.STATISTICS.items():
            values = [policy["metrics"][metric][statistic] for policy in here]
            estimates = [value if isinstance(value, dict) else {"value": value} for value in values]
            best = text.best(estimates, metric, text.safe(data))
            cells = [
                {
                    "value": text.number(one["value"], text.worst(metric)),
                    "interval": text.interval(one) if "low" in one else "",
                    "best": k in best,
                }
                for k, one in enumerate(estimates)
            ]
            main = statistic == text.MAIN[metric]
            unit = data["units"][metric]
            rows.append({"metric": name, "unit": unit, "statistic": words, "cells": cells, "main": main})
    return rows


def _table(data: Data, metric: str, title: str) -> Data:
    """One metric over the shifts."""
    rows = [
        {"title": shift["title"], "cells": [_cell(policy, metric) for policy in shift["policies"]]}
        for shift in data["shifts"]
    ]
    return {
        "title": title,
        "statistic": text.MAIN[metric],
        "open": metric in OPEN,
        "rows": rows,
        "unit": data["units"][metric],
    }


def _cell(policy: Data, metric: str) -> Data:
    estimate = policy["metrics"][metric][text.MAIN[metric]]
    return {
        "value": text.number(estimate["value"], text.worst(metric)),
        "interval": text.interval(estimate),
        "verdict": text.verdict(policy["against"], metric),
        "mark": text.mark(policy["against"], metric),
        "left": text.left(policy),
    }
