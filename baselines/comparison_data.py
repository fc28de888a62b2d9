"""The whole comparison as plain data: what `results.json` holds and every table, figure and page is made from."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from baselines import comparison_summary as summary
from baselines import learning_curves
from baselines.comparison import MEASURES, Array, Played, Policy
from baselines.comparison_summary import Bootstrap, Data
from baselines.metrics import METRICS
from baselines.shifts import IN_DISTRIBUTION, Shift

FORMAT = "mfc-gym comparison 1"
SEEDS = 5  # trainings that an algorithm should be judged by


@dataclass(frozen=True)
class Contest:
    """What was played: policies, shifts and scores, everything by label and name."""

    environment: Mapping[str, Any]  # `id` and `options`
    seeds: range
    policies: list[Policy]
    reference: str  # label of the reference policy
    shifts: Mapping[str, Shift]
    played: Mapping[str, Mapping[str, Played]]  # shift -> label
    zero: Mapping[str, Mapping[str, Array]]  # shift -> metric -> (1, episodes), of the zero input

    def scores(self, label: str, metric: str) -> dict[str, Array]:
        """One metric of a policy by shift, each (runs, episodes)."""
        return {name: by_label[label].scores[metric] for name, by_label in self.played.items()}


def data(contest: Contest, bootstrap: Bootstrap, progress: Callable[[], object] = lambda: None) -> Data:
    """All statistics. `progress` is called once for each policy and shift."""
    shifts = []
    for name, shift in contest.shifts.items():
        by_label, changes = contest.played[name], asdict(shift)
        tau = summary.thresholds([one.scores["tail_rms"] for one in by_label.values()])
        policies = []
        for label, one in by_label.items():
            policies.append(_policy(label, one, by_label[contest.reference], tau, bootstrap, contest.reference))
            progress()
        title = changes.pop("title")
        what = {"name": name, "title": title, "changes": changes, "copies": _copies(by_label)}
        shifts.append({**what, "tau": tau.tolist(), "policies": policies})
    return {
        "format": FORMAT,
        "environment": dict(contest.environment),
        "seeds": {"first": contest.seeds.start, "episodes": len(contest.seeds)},
        "bootstrap": asdict(bootstrap),
        "units": {name: METRICS[name].unit for name in MEASURES},
        "reference": contest.reference,
        "policies": [_described(policy, contest) for policy in contest.policies],
        "shifts": shifts,
        "scores": _scores(contest, bootstrap),
        "learning": _learning(contest, bootstrap),
    }


def _copies(by_label: Mapping[str, Played]) -> bool:
    """Whether there are several episodes and every run does the same in all of them."""
    scores = np.stack([run for one in by_label.values() for measure in MEASURES for run in one.scores[measure]])
    return scores.shape[1] > 1 and bool((scores == scores[:, :1]).all())


def _policy(label: str, one: Played, reference: Played, tau: Array, bootstrap: Bootstrap, against: str) -> Data:
    return {
        "label": label,
        "metrics": summary.describe(one.scores, bootstrap),
        "against": None if label == against else summary.against(one.scores, reference.scores, bootstrap),
        "profile": summary.profile(one.scores["tail_rms"], tau, bootstrap),
    }


def _described(policy: Policy, contest: Contest) -> Data:
    """Where a policy comes from, and what the reader should know about it."""
    entries = contest.played[IN_DISTRIBUTION][policy.label].entries
    trained = [entry.options["environment"] for entry in entries if "environment" in entry.options]
    found: Data = {
        "label": policy.label,
        "specifications": list(policy.specifications),
        "reads": list(entries[0].reads),
        "runs": len(entries),
        "trained": bool(trained),
        "trainings": [_origin(entry) for entry in entries] if trained else [],
        "notes": [],
    }
    task = _comparable(contest.environment)
    if any(_comparable(one) != task for one in trained):
        found["notes"].append("trained on another task than the one that is called in distribution here")
    if trained and len(trained) < SEEDS:
        found["notes"].append(
            f"trainings: {len(trained)}; an interval over fewer than {SEEDS} says little about others"
        )
    seeds = [one["seed"] for one in found["trainings"] if one["seed"] is not None]
    if len(set(seeds)) < len(seeds):
        found["notes"].append("some trainings have the same seed")
    return found


def _comparable(environment: Mapping[str, Any]) -> Data:
    options = {k: v for k, v in environment.get("options", {}).items() if k != "system"}
    return {"id": environment.get("id"), **options}


def _training(entry: Any) -> Mapping[str, Any]:
    found = getattr(entry.policy, "training", {})
    return found if isinstance(found, Mapping) else {}


def _origin(entry: Any) -> Data:
    """Seed and timesteps of a training, as its file says."""
    given = _training(entry)
    return {k: given[k] if type(given.get(k)) is int else None for k in ("seed", "timesteps")}


def _scores(contest: Contest, bootstrap: Bootstrap) -> Data | None:
    """Normalised scores over all shifts, from the return, which is finite for every policy."""
    zero = {name: -scores["return"] for name, scores in contest.zero.items()}
    costs = {p.label: {k: -v for k, v in contest.scores(p.label, "return").items()} for p in contest.policies}
    found = {label: summary.normalised(cost, zero, costs[contest.reference]) for label, cost in costs.items()}
    scores = {label: one for label, one in found.items() if one is not None}
    if not scores:
        return None
    policies = [{"label": label, **summary.aggregate(one, bootstrap)} for label, one in scores.items()]
    return {"shifts": list(next(iter(scores.values()))), "policies": policies}


def _learning(contest: Contest, bootstrap: Bootstrap) -> Data:
    """Learning curves of the trained policies, and the reference policy's level: its median tail RMS here."""
    played = contest.played[IN_DISTRIBUTION]
    level = summary.number(np.median(played[contest.reference].scores["tail_rms"]))
    curves = []
    for policy in contest.policies:
        every = [learning_curves.curve(_training(entry)) for entry in played[policy.label].entries]
        found = learning_curves.aggregate([one for one in every if one], level, bootstrap.reps, bootstrap.seed)
        if found is not None:
            curves.append({"label": policy.label, **found})
    return {"level": level, "curves": curves}
