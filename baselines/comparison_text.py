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
STATISTICS = {
    "median": "median",
    "iqm": "interquartile mean",
    "mean": "mean",
    "cvar": "mean of the worst tenth",
    "worst": "worst",
}
EVEN = 1.05  # ratio of medians below which two policies count as equal
VERDICTS = {"better": "▲", "worse": "▼", "even": "≈"}


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
    """better, worse or even, beside the reference policy on the same episodes; None for the reference policy itself.

    Costs: whether the interval of the probability of improvement excludes 1/2, and the median ratio is off 1 by 5 % or more.
    The return: whether the interval of the mean difference excludes 0, so that rare disasters count.
    """
    if against is None:
        return None
    found = against[metric]
    if metric == "return":
        return _side(found["difference"], 0.0)
    ratio = found["ratio"]["value"] if "ratio" in found else None
    even = ratio is not None and 1 / EVEN < ratio < EVEN
    return "even" if even else _side(found["improvement"], 0.5)


def _side(estimate: Data, middle: float) -> str:
    low, high = estimate["low"], estimate["high"]
    return "better" if low is not None and low > middle else "worse" if high is not None and high < middle else "even"


def mark(against: Data | None, metric: str) -> str:
    """The verdict with the factor, where there is one: `▼ 4.1x`."""
    found = verdict(against, metric)
    if against is None or found is None:
        return ""
    if found == "even" or "ratio" not in against[metric]:
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


def best(values: list[float | None], metric: str) -> int | None:
    """Which one is alone the best; None: none is."""
    sign = -1.0 if metric == "return" else 1.0
    keys = [float("inf") if value is None else sign * value for value in values]
    least = min(keys)
    return keys.index(least) if least < float("inf") and keys.count(least) == 1 else None


def title(data: Data) -> str:
    """The answer in one line."""
    here = in_distribution(data)["policies"]
    tail = best([policy["metrics"]["tail_rms"]["median"]["value"] for policy in here], "tail_rms")
    gain = best([policy["metrics"]["return"]["mean"]["value"] for policy in here], "return")
    if tail is None or gain is None:
        return "No policy is alone the best"
    if tail == gain:
        return f"{here[tail]['label']} is the most accurate and has the best return"
    return f"{here[tail]['label']} is the most accurate in the tail, {here[gain]['label']} has the best return"


def headline(data: Data) -> list[str]:
    """The answer in a few sentences."""
    reference, here = data["reference"], by_label(in_distribution(data))
    error = {label: p["metrics"]["tail_rms"]["median"]["value"] for label, p in here.items()}
    tail = best(list(error.values()), "tail_rms")
    first = None if tail is None else list(error)[tail]
    sentences = [f"In distribution {first} is the most accurate in the tail: median RMS {number(error[first])}."] if first else []
    for label, policy in here.items():
        if label != reference:
            sentences.append(_beside(label, policy, here[reference], data))
    return sentences


def _beside(label: str, policy: Data, reference: Data, data: Data) -> str:
    """One policy beside the reference policy."""
    words = {"better": "a better", "worse": "a worse", "even": "about the same"}
    found = {m: verdict(policy["against"], m) or "even" for m in ("tail_rms", "return")}
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
        f"{counts['worse']}, about the same in {counts['even']}; it left the operating region in {left} of {episodes} episodes."
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
    "episodes, by the median factor; ≈ within 5 % or not distinguishable. An episode that leaves the operating region has an infinite cost: "
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
    chosen = best(values, metric)
    return [f"**{one}**" if k == chosen else one for k, one in enumerate(shown)]


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
