"""A comparison in words and as Markdown, from its data."""

import html
import re
from typing import Any

from baselines.shifts import IN_DISTRIBUTION

Data = dict[str, Any]

METRICS = {
    "tail_rms": "tail RMS of y - y_d",
    "transient_iae": "integral of abs(y - y_d), transient",
    "return": "return",
    "tail_total_variation_rate": "variation of u per second, tail",
}
SAME = 1.05  # ratio of medians below which two policies count as equal
VERDICTS = {"better": "▲", "worse": "▼", "same": "≈"}


def number(value: float | None, infinite: str = "∞") -> str:
    """Three digits at most, 1.7e-3 rather than 0.0017; None is infinite."""
    if value is None:
        return infinite
    if value == 0 or 0.01 <= abs(value) < 1000:
        return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def interval(estimate: Data) -> str:
    """[low, high]."""
    return f"[{number(estimate['low'], '-∞')}, {number(estimate['high'])}]"


def worst(metric: str) -> str:
    """What an infinite value of a metric means."""
    return "-∞" if metric == "return" else "∞"


def verdict(against: Data | None, metric: str) -> str | None:
    """better, worse or same than the reference policy on the same episodes; None for the reference policy itself.

    Better: the 95 % interval of the probability of improvement lies above 1/2, and the ratio differs by 5 % or more.
    """
    if against is None:
        return None
    found, p = against[metric], against[metric]["improvement"]
    ratio = found["ratio"]["value"] if "ratio" in found else None
    if "ratio" in found and ratio is not None and 1 / SAME < ratio < SAME:
        return "same"
    return "better" if p["low"] > 0.5 else "worse" if p["high"] < 0.5 else "same"


def mark(against: Data | None, metric: str) -> str:
    """The verdict with the factor, where there is one: `▼ 4.1x`."""
    found = verdict(against, metric)
    if against is None or found is None:
        return ""
    if found == "same" or "ratio" not in against[metric]:
        return f"{VERDICTS[found]} {found}"
    ratio = against[metric]["ratio"]["value"]
    factor = None if ratio is None or ratio == 0 else max(ratio, 1 / ratio)
    return f"{VERDICTS[found]} {number(factor)}× {found}"


def by_label(shift: Data) -> dict[str, Data]:
    """The policies of a shift."""
    return {policy["label"]: policy for policy in shift["policies"]}


def in_distribution(data: Data) -> Data:
    """The shift that is none."""
    return next(shift for shift in data["shifts"] if shift["name"] == IN_DISTRIBUTION)


def headline(data: Data) -> list[str]:
    """The answer in a few sentences."""
    reference, here = data["reference"], by_label(in_distribution(data))
    error = {label: p["metrics"]["tail_rms"]["median"]["value"] for label, p in here.items()}
    best = min(error, key=lambda label: float("inf") if error[label] is None else error[label])
    sentences = [f"In distribution {best} is the most accurate in the tail: median RMS {number(error[best])}."]
    for label, policy in here.items():
        if label != reference:
            sentences.append(_beside(label, policy, here[reference], data))
    return sentences


def _beside(label: str, policy: Data, reference: Data, data: Data) -> str:
    """One policy beside the reference policy."""
    words = {"better": "a better", "worse": "a worse", "same": "the same"}
    found = {m: verdict(policy["against"], m) or "same" for m in ("tail_rms", "return")}
    tail, p = policy["metrics"]["tail_rms"]["median"], policy["against"]["tail_rms"]["improvement"]
    gain = [policy["metrics"]["return"]["mean"], reference["metrics"]["return"]["mean"]]
    text = (
        f"{label}, against {data['reference']}: {words[found['tail_rms']]} tail error (median {number(tail['value'])}; "
        f"smaller on {100 * p['value']:.0f} % of the episodes), {words[found['return']]} return "
        f"({number(gain[0]['value'])} against {number(gain[1]['value'])})."
    )
    shifts = [by_label(shift)[label] for shift in data["shifts"] if shift["name"] != IN_DISTRIBUTION]
    if not shifts:
        return text
    counts = {v: sum(verdict(one["against"], "tail_rms") == v for one in shifts) for v in VERDICTS}
    left = sum(one["metrics"]["escaped"]["count"] for one in shifts)
    episodes = sum(one["metrics"]["escaped"]["episodes"] for one in shifts)
    return (
        f"{text} Under {len(shifts)} shifts its tail error is smaller in {counts['better']}, larger in "
        f"{counts['worse']}, the same in {counts['same']}; it left the operating region in {left} of {episodes} episodes."
    )


def markdown(data: Data) -> str:
    """The tables as Markdown: in distribution first, then one table over the shifts for each metric."""
    labels = [policy["label"] for policy in data["policies"]]
    parts = ["## In distribution", _first_table(data), "## Under shifts"]
    for metric, title in METRICS.items():
        rows = [
            [cell(shift["title"]), *(_shift_cell(by_label(shift)[label], metric) for label in labels)]
            for shift in data["shifts"]
        ]
        statistic = "mean" if metric == "return" else "median"
        parts.append(f"{statistic} of: {title}\n\n{_table(['', *map(cell, labels)], rows)}")
    parts.append(" ".join(map(cell, headline(data))))
    parts.append(LEGEND)
    return "\n\n".join(parts) + "\n"


LEGEND = (
    "Brackets: 95 % bootstrap interval over trainings and episodes. ▲ better, ▼ worse than the reference policy on the same "
    "episodes, by the median factor; ≈ no difference. An episode that leaves the operating region has an infinite cost: "
    "∞ means that too many did."
)


def _first_table(data: Data) -> str:
    """What the README shows."""
    here = list(by_label(in_distribution(data)).values())
    rows: list[list[str]] = []
    for name, metric, statistic in (
        ("tail RMS, median", "tail_rms", "median"),
        ("tail RMS, interquartile mean", "tail_rms", "iqm"),
        ("tail RMS, mean of the worst tenth", "tail_rms", "cvar"),
        ("integral of abs(y - y_d) in the transient, median", "transient_iae", "median"),
        ("return, mean", "return", "mean"),
    ):
        estimates = [policy["metrics"][metric][statistic] for policy in here]
        shown = [f"{number(one['value'], worst(metric))} {interval(one)}" for one in estimates]
        rows.append([name, *_bold(shown, [one["value"] for one in estimates], metric)])
    worsts = [policy["metrics"]["tail_rms"]["worst"] for policy in here]
    rows.insert(3, ["tail RMS, worst", *_bold([number(value) for value in worsts], worsts, "tail_rms")])
    left = [policy["metrics"]["escaped"] for policy in here]
    rows.append(["left the operating region", *(f"{one['count']} of {one['episodes']}" for one in left)])
    return _table(["", *(cell(_with_runs(policy)) for policy in data["policies"])], rows)


def _with_runs(policy: Data) -> str:
    return f"{policy['label']}, {policy['runs']} trainings" if policy["trained"] else policy["label"]


def _bold(shown: list[str], values: list[float | None], metric: str) -> list[str]:
    """The best one bold."""
    sign = -1.0 if metric == "return" else 1.0
    keys = [float("inf") if value is None else sign * value for value in values]
    best = min(keys)
    return [f"**{s}**" if k == best < float("inf") and keys.count(best) == 1 else s for s, k in zip(shown, keys, strict=True)]


def _shift_cell(policy: Data, metric: str) -> str:
    estimate = policy["metrics"][metric]["mean" if metric == "return" else "median"]
    left = policy["metrics"]["escaped"]["count"]
    parts = [number(estimate["value"], worst(metric)), interval(estimate), mark(policy["against"], metric)]
    return " ".join([*filter(None, parts), *([f"({left} left)"] if left else [])])


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(text: str) -> str:
    """Text from a file or the command line, harmless in a Markdown table."""
    plain = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~])", r"\\\1", plain)
