"""A comparison in words and as Markdown, from its data."""

import html
import math
import re
from dataclasses import dataclass
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
MAIN = {"tail_rms": "median", "transient_iae": "median", "return": "mean", "tail_total_variation_rate": "median"}
EVEN = 1.05  # median ratio, or relative mean return, within which two policies count as equal
VERDICTS = {"better": "▲", "worse": "▼", "even": "≈"}


def number(value: float | None, infinite: str = "∞") -> str:
    """Two digits, 1.7e-3 rather than 0.0017; None is infinite."""
    if value is None:
        return infinite
    if value == 0 or 0.01 <= abs(value) < 1000:
        return f"{value:#.2g}".rstrip(".") if abs(value) < 99.5 else f"{value:.0f}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def interval(estimate: Data) -> str:
    """[low, high] of a cost or of the return; empty where nothing varies."""
    if estimate["low"] == estimate["value"] == estimate["high"]:
        return ""
    low = number(estimate["low"], "∞" if estimate["value"] is None else "-∞")
    return f"[{low}, {number(estimate['high'])}]"


def worst(metric: str) -> str:
    """What an infinite value of a metric means."""
    return "-∞" if metric == "return" else "∞"


def verdict(against: Data | None, metric: str) -> str | None:
    """better, worse or even, beside the reference policy on the same episodes; None for the reference policy itself.

    Costs: whether the interval of the probability of improvement excludes 1/2, and the median ratio is off 1 by 5 % or more.
    The return: whether the interval of the mean difference excludes 0, so that rare disasters count, and it is 5 % or more.
    """
    if against is None:
        return None
    found = against[metric]
    if metric == "return":
        even = abs(found["difference"]["value"]) < (EVEN - 1) * found["size"]
        return "even" if even else _side(found["difference"], 0.0)
    ratio = found["ratio"]["value"]
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


def left(policy: Data) -> str:
    """How many episodes left the operating region, of how many; empty for none."""
    escaped = policy["metrics"]["escaped"]
    return f"{escaped['count']} of {escaped['episodes']}" if escaped["count"] else ""


def by_label(shift: Data) -> dict[str, Data]:
    """The policies of a shift."""
    return {policy["label"]: policy for policy in shift["policies"]}


def in_distribution(data: Data) -> Data:
    """The shift that is none."""
    return next(shift for shift in data["shifts"] if shift["name"] == IN_DISTRIBUTION)


def safe(data: Data) -> set[int]:
    """The policies that stay in the operating region, in distribution, as often as the best does: their intervals overlap."""
    rates = [policy["metrics"]["escaped"]["rate"] for policy in in_distribution(data)["policies"]]
    least = min(rates, key=lambda rate: (rate["value"], rate["high"]))
    return {k for k, rate in enumerate(rates) if rate["low"] <= least["high"]}


def best(estimates: list[Data], metric: str, among: set[int]) -> set[int]:
    """The best ones: the best value, and those whose intervals overlap its interval; none if that holds for all."""
    sign = -1.0 if metric == "return" else 1.0
    costs = [_infinite(one["value"], sign) for one in estimates]
    least = min(among, key=lambda k: costs[k])
    if costs[least] == math.inf:
        return set()
    ends = ("low", "high") if sign > 0 else ("high", "low")
    low, high = ([_infinite(one.get(end, one["value"]), sign) for one in estimates] for end in ends)
    found = {k for k in among if low[k] <= high[least]}
    return found if len(found) < len(costs) or len(costs) == 1 else set()


def _infinite(value: float | None, sign: float) -> float:
    return math.inf if value is None else sign * value


def title(data: Data) -> str:
    """The answer in one line."""
    here = in_distribution(data)["policies"]
    tail = best([policy["metrics"]["tail_rms"]["median"] for policy in here], "tail_rms", safe(data))
    gain = best([policy["metrics"]["return"]["mean"] for policy in here], "return", safe(data))
    labels = [policy["label"] for policy in here]
    if tail == gain:
        who, be, have = _names(labels, tail)
        return f"{who} {be} the most accurate and {have} the best return" if tail else "No policy is ahead"
    parts = []
    for chosen, word, rest in ((tail, 1, "the most accurate in the tail"), (gain, 2, "the best return")):
        if chosen:
            found = _names(labels, chosen)
            parts.append(f"{found[0]} {found[word]} {rest}")
    return ", ".join(parts)


def _names(labels: list[str], chosen: set[int]) -> tuple[str, str, str]:
    """The names, and the forms of be and have that go with them."""
    named = [labels[k] for k in sorted(chosen)]
    return (" and ".join(named), "is", "has") if len(named) < 2 else (" and ".join(named), "are", "have")


def headline(data: Data) -> dict[str, str]:
    """What is to be said of each policy."""
    here, reference = by_label(in_distribution(data)), data["reference"]
    return {label: _beside(label, one, here[reference], data) for label, one in here.items() if label != reference}


def _beside(label: str, policy: Data, reference: Data, data: Data) -> str:
    """One policy beside the reference policy, in distribution and under the shifts."""
    name, tail, ratio = data["reference"], policy["metrics"]["tail_rms"], policy["against"]["tail_rms"]["ratio"]
    gain = [one["metrics"]["return"]["mean"] for one in (policy, reference)]
    sentences = [
        f"Median tail RMS {number(tail['median']['value'])}, {number(ratio['value'])} times that of {name}; mean return "
        f"{number(gain[0]['value'])} against {number(gain[1]['value'])} ({verdict(policy['against'], 'return')}); "
        f"left the operating region in {_left([policy])} episodes."
    ]
    shifts = [by_label(shift) for shift in data["shifts"] if shift["name"] != IN_DISTRIBUTION]
    if shifts:
        own, others = _left([shift[label] for shift in shifts]), _left([shift[name] for shift in shifts])
        found = [verdict(shift[label]["against"], "tail_rms") for shift in shifts]
        sentences.append(
            f"Under {len(shifts)} shift{'s' if len(shifts) > 1 else ''} the tail error is smaller in {found.count('better')}, "
            f"larger in {found.count('worse')}, about the same in {found.count('even')}; "
            f"left the region in {own} episodes ({name}: {others})."
        )
    return " ".join(sentences)


def _left(policies: list[Data]) -> str:
    count, episodes = (sum(one["metrics"]["escaped"][key] for one in policies) for key in ("count", "episodes"))
    return f"{count} of {episodes}"


@dataclass(frozen=True)
class Cell:
    """What a table says of one policy: the value, its interval, further remarks."""

    parts: tuple[str, ...]
    best: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of a name and one cell for each policy."""

    title: str
    policies: list[str]
    rows: list[tuple[str, list[Cell]]]


def markdown(data: Data) -> str:
    """The tables as Markdown: in distribution first, then one table over the shifts for each metric."""
    first, *others = (_table(table) for table in tables(data))
    return "\n\n".join(["## In distribution", first, "## Under shifts", *others, words(data)]) + "\n"


def words(data: Data) -> str:
    """What is to be said of each policy, and how to read the tables, as Markdown."""
    said = [f"**{cell(label)}** {cell(sentence)}" for label, sentence in headline(data).items()]
    return "\n\n".join([*said, *filter(None, [copies(data)]), LEGEND])


def copies(data: Data) -> str:
    """Which shifts have nothing random in them, where there are any."""
    titles = [shift["title"] for shift in data["shifts"] if shift["copies"]]
    return f"All episodes are the same, so there are no intervals over them: {'; '.join(titles)}." if titles else ""


def tables(data: Data) -> list[Table]:
    """In distribution first, then over the shifts for each metric."""
    labels = [policy["label"] for policy in data["policies"]]
    found = [Table("", [_with_runs(policy) for policy in data["policies"]], _first_rows(data))]
    for metric, title in METRICS.items():
        rows = [
            (shift["title"], [_shift_cell(by_label(shift)[label], metric) for label in labels])
            for shift in data["shifts"]
        ]
        found.append(Table(f"{MAIN[metric]} of: {title}", labels, rows))
    return found


LEGEND = (
    "Brackets: 95 % bootstrap interval over trainings and episodes. Bold: the best, and those whose intervals overlap its own, "
    "among the policies that stay in the operating region as often as the best does; nothing is bold where all overlap. "
    "▲ better, ▼ worse than the reference policy on the same episodes, by the median factor; ≈ within 5 % or not "
    "distinguishable. An episode that leaves the operating region has an infinite cost: ∞ means that too many did."
)


def _first_rows(data: Data) -> list[tuple[str, list[Cell]]]:
    """What the README shows."""
    here = list(by_label(in_distribution(data)).values())
    rows: list[tuple[str, list[Cell]]] = []
    for name, metric, statistic in (
        ("tail RMS, median", "tail_rms", "median"),
        ("tail RMS, interquartile mean", "tail_rms", "iqm"),
        ("tail RMS, mean of the worst tenth", "tail_rms", "cvar"),
        ("integral of abs(y - y_d) in the transient, median", "transient_iae", "median"),
        ("return, mean", "return", "mean"),
    ):
        estimates = [policy["metrics"][metric][statistic] for policy in here]
        rows.append((name, _cells(estimates, metric, safe(data))))
    worsts = [{"value": policy["metrics"]["tail_rms"]["worst"]} for policy in here]
    rows.insert(3, ("tail RMS, worst", _cells(worsts, "tail_rms", safe(data))))
    left = [policy["metrics"]["escaped"] for policy in here]
    rows.append(("left the operating region", [Cell((f"{one['count']} of {one['episodes']}",)) for one in left]))
    return rows


def _with_runs(policy: Data) -> str:
    return f"{policy['label']}, {trainings(policy['runs'])}" if policy["trained"] else policy["label"]


def trainings(count: int) -> str:
    """A number of trainings in words."""
    return f"{count} training{'' if count == 1 else 's'}"


def _cells(estimates: list[Data], metric: str, among: set[int]) -> list[Cell]:
    """One for each policy."""
    chosen = best(estimates, metric, among)
    shown = [(number(one["value"], worst(metric)), interval(one) if "low" in one else "") for one in estimates]
    return [Cell(tuple(filter(None, parts)), k in chosen) for k, parts in enumerate(shown)]


def _shift_cell(policy: Data, metric: str) -> Cell:
    estimate = policy["metrics"][metric][MAIN[metric]]
    parts = [number(estimate["value"], worst(metric)), interval(estimate), mark(policy["against"], metric)]
    gone = [f"({left(policy)} left)"] if left(policy) else []
    return Cell(tuple(filter(None, [*parts, *gone])))


def _table(table: Table) -> str:
    rows = [[name, *(_bold(" ".join(one.parts), one.best) for one in cells)] for name, cells in table.rows]
    lines = [["", *map(cell, table.policies)], ["---"] * (1 + len(table.policies)), *rows]
    drawn = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table.title}\n\n{drawn}" if table.title else drawn


def _bold(text: str, best: bool) -> str:
    return f"**{text}**" if best else text


def cell(text: str) -> str:
    """Text from a file or the command line, harmless in a Markdown table."""
    plain = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~])", r"\\\1", plain)
