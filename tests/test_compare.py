"""Comparisons: pairing, shifts, statistics of escapes, and output that is finite, harmless and reproducible."""

import csv
import json
import math
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.progress import Progress

pytest.importorskip("safetensors")

import baselines
from baselines import comparison, comparison_data, learning_curves, shifts
from baselines import comparison_summary as summary
from baselines import comparison_text as text
from baselines.agent_files import save_agent
from baselines.comparison import MEASURES, Setting, ZeroInput, policies
from baselines.comparison_summary import Bootstrap
from baselines.metrics import evaluate
from baselines.policy_network import Agent, Features
from baselines.shifts import SHIFTS
from scripts import compare

ROOT = Path(__file__).parents[1]
CHAIN = "mfc_gym/PerturbedChain-v0"
TASK: dict[str, Any] = {"scenario": "random", "dt": 0.02, "horizon": 2.0}
SMALL = Bootstrap(reps=100)
HOSTILE = "<script>alert(1)</script>|$\\frac{"


def save(folder: Path, seed: int, gain: float = 1.0, **training: Any) -> Path:
    """A linear agent u = -gain e_1 that nobody trained, with what its file says about its training."""
    matrix = np.zeros((1, 10))
    matrix[0, [3, 6]] = -gain, gain
    layers = ((np.ones((1, 1)), np.zeros(1)),)
    environment = {"id": CHAIN, "options": TASK}
    agent = Agent("PPO", Features(matrix, np.zeros(1)), layers, "tanh", "clip", environment, {"seed": seed, **training})
    save_agent(agent, folder)
    return folder


def arguments(tmp_path: Path, *named: str, **options: Any) -> compare.Arguments:
    small: dict[str, Any] = {"episodes": 4, "horizon": 1.0, "reps": 50, "shifts": ("slower",), "out": tmp_path / "out"}
    return compare.Arguments(named, **(small | options))


# -- what is played ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIFTS)
def test_every_shift_is_an_environment_and_one_changes_nothing(name: str) -> None:
    setting = Setting(CHAIN, TASK, SHIFTS[name])
    assert set(setting.options) >= set(TASK)
    base: Any = gym.make(CHAIN, **TASK).unwrapped
    same = setting.options == {**TASK, "dt": base.dt, "horizon": base.simulation.horizon}
    assert same == (name in (shifts.IN_DISTRIBUTION, "initial"))  # the latter changes the reset
    assert setting.simulation.dt == pytest.approx(SHIFTS[name].dt * base.dt, rel=1e-15)


def test_noise_is_in_units_of_the_reference() -> None:
    setting = Setting("mfc_gym/MagneticLevitation-v0", {}, SHIFTS["noise"])
    scale = setting.simulation.plant.task.reference_scale
    assert scale != 1
    assert setting.options["sensors"]["noise"] == 1e-5 * scale


def test_a_shift_that_changes_nothing_is_left_out() -> None:
    """No initial set, and three sines as the plant's own reference."""
    given = {"system": str(ROOT / "docs" / "plants" / "van_der_pol.toml"), "reference": "multisine"}
    plant: Any = gym.make("mfc_gym/Plant-v0", **given).unwrapped
    assert [n for n, one in SHIFTS.items() if not one.applies(given, plant.simulation)] == ["initial", "multisine"]
    chain: Any = gym.make(CHAIN, **TASK).unwrapped
    assert all(shift.applies(TASK, chain.simulation) for shift in SHIFTS.values())


def test_wider_initial_states_are_those_of_the_same_episodes() -> None:
    """The chain's set is centred at 0: twice the state, the same theta and reference."""
    envs: Any = gym.make_vec(CHAIN, 5, vectorization_mode="vector_entry_point", **TASK)
    envs.reset(seed=3)
    x, theta, reference = envs.rows[:, :3].copy(), envs.theta.copy(), envs.reference_parameters.copy()
    envs.reset(seed=3, options=SHIFTS["initial"].reset_options(envs, 3))
    np.testing.assert_array_equal(envs.rows[:, :3], 2 * x)
    np.testing.assert_array_equal(envs.theta, theta)
    np.testing.assert_array_equal(envs.reference_parameters, reference)


def test_episodes_are_those_of_the_scalar_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the blocks: seed s + i, bit for bit."""
    monkeypatch.setattr(comparison, "BLOCK", 2)
    setting = Setting(CHAIN, TASK, SHIFTS["slower"])
    (policy,) = policies(["mfc"])
    scores = comparison.play(policy, setting, range(5, 8)).scores
    env = gym.make(CHAIN, **{**TASK, "dt": 0.04})
    for i, seed in enumerate((5, 6, 7)):
        episode = evaluate(baselines.rollout(env, baselines.make("mfc", env), seed=seed), 50.0, 2.0)
        assert {name: scores[name][0, i] for name in MEASURES} == {name: episode[name] for name in MEASURES}


def test_all_policies_see_the_same_episodes() -> None:
    setting = Setting(CHAIN, TASK, SHIFTS["slower"])
    one, other = (next(setting.play(policy, range(9, 11))) for policy in (ZeroInput(), ZeroInput()))
    np.testing.assert_array_equal(one.state, other.state)
    (mfc,) = policies(["mfc"])
    first = comparison.play(mfc, setting, range(9, 11)).first
    np.testing.assert_array_equal(first.state[0], one.state[0])
    n = min(len(first.reference), len(one.reference))
    np.testing.assert_array_equal(first.reference[:n], one.reference[:n])


def test_policies_by_label_glob_and_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for i in range(3):
        save(tmp_path / f"a-{i}", i)
    found = policies(["mfc", "mfc:gain=paper", "ppo:a-*", "two=ppo:a-0,a-2", "law=mfc:design=paper"])
    assert [(one.label, one.specifications) for one in found] == [
        ("mfc", ("mfc",)),
        ("mfc:gain=paper", ("mfc:gain=paper",)),
        ("ppo", ("ppo:a-0", "ppo:a-1", "ppo:a-2")),
        ("two", ("ppo:a-0", "ppo:a-2")),
        ("law", ("mfc:design=paper",)),
    ]
    assert [one.label for one in policies(["ppo:a-0", "ppo:a-1"])] == ["ppo:a-0", "ppo:a-1"]


# -- what is said of it -----------------------------------------------------------------------------------------------


def scores(tail: Any) -> dict[str, np.ndarray]:
    """Scores (runs, episodes) whose tail RMS is given; infinite means escaped."""
    x = np.asarray(tail, dtype=float)
    escaped = np.isinf(x)
    found = dict.fromkeys(MEASURES, x)
    return found | {"escaped": escaped.astype(float), "return": -np.where(escaped, 50.0, x)}


def test_a_policy_beside_itself_is_even(rng: np.random.Generator) -> None:
    x = scores(np.r_[rng.lognormal(size=20), np.inf][None])
    found = summary.against(x, x, SMALL)
    for metric in text.METRICS:
        assert found[metric]["difference"] == {"value": 0, "low": 0, "high": 0}
        assert found[metric]["improvement"] == {"value": 0.5, "low": 0.5, "high": 0.5}
        assert text.verdict(found, metric) == "even"
    assert found["tail_rms"]["ratio"] == {"value": 1, "low": 1, "high": 1}


def test_pairs_share_their_episodes(rng: np.random.Generator) -> None:
    """Episodes differ by decades, the two policies by a factor of 2 on each: the ratio's interval is a point."""
    y = 10.0 ** rng.integers(-5, 0, size=(1, 30))
    found = summary.against(scores(np.vstack([2 * y, 2 * y])), scores(y), SMALL)
    assert found["tail_rms"]["ratio"] == {"value": 2, "low": 2, "high": 2}
    assert found["tail_rms"]["improvement"]["high"] == 0
    assert text.mark(found, "tail_rms") == "▼ 2.0× worse"


def test_infinite_costs_are_null_and_counted() -> None:
    x = np.arange(1.0, 9)
    few, many = np.where(x > 7, np.inf, x)[None], np.where(x > 3, np.inf, x)[None]
    one, all_but = summary.describe(scores(few), SMALL), summary.describe(scores(many), SMALL)
    assert one["tail_rms"]["iqm"]["value"] == 4.5
    assert one["tail_rms"]["mean"]["value"] is one["tail_rms"]["cvar"]["value"] is one["tail_rms"]["worst"] is None
    assert all_but["tail_rms"]["median"] == {"value": None, "low": all_but["tail_rms"]["median"]["low"], "high": None}
    assert all_but["escaped"]["count"] == 5
    assert one["return"]["mean"]["value"] == -(28 + 50) / 8
    json.dumps([one, all_but], allow_nan=False)
    beside = summary.against(scores(few), scores(many), SMALL)  # where both escape there is no difference
    assert beside["tail_rms"]["difference"]["value"] == beside["tail_rms"]["difference"]["low"]
    assert beside["tail_rms"]["improvement"]["value"] == (4 + 4 / 2) / 8


def test_comparisons_of_infinities_by_hand() -> None:
    inf = math.inf
    x, y = np.array([1.0, inf, 2.0, inf, 0.0]), np.array([2.0, 3.0, inf, inf, 0.0])
    np.testing.assert_array_equal(summary.difference(x, y), [-1, inf, -inf, 0, 0])
    np.testing.assert_array_equal(summary.ratio(x, y), [0.5, inf, 0, 1, 1])
    assert summary.lower_median(np.array([[inf, -inf]])) == -inf
    with pytest.raises(ValueError, match="must be a number, got NaN"):
        summary.number(math.nan)


def test_no_escape_of_n_does_not_mean_never() -> None:
    """Clopper and Pearson: 1 - (0.05/2)^(1/n) for none of n."""
    rate = summary.describe(scores(np.ones((2, 50))), SMALL)["escaped"]["rate"]
    assert (rate["value"], rate["low"]) == (0, 0)
    assert rate["high"] == pytest.approx(1 - 0.025 ** (1 / 100), rel=1e-9)


def test_profile_is_the_fraction_below() -> None:
    found = summary.profile(np.array([[1.0, 2, 3, math.inf]]), np.array([0.5, 1.5, 3.5]), SMALL)
    assert found["value"] == [0, 0.25, 0.75]


def test_scores_are_normalised_task_by_task() -> None:
    costs = {"a": np.array([[1.0, 3.0]]), "b": np.array([[20.0, 10.0]])}
    zero, reference = (
        {k: np.full((1, 2), 102.0) for k in costs},
        {"a": np.full((1, 2), 2.0), "b": np.full((1, 2), 102.0)},
    )
    found = summary.normalised(costs, zero, reference)  # the reference is no better than nothing on b
    assert found is not None
    np.testing.assert_array_equal(found["a"], [[1.01, 0.99]])
    assert set(found) == {"a"}
    assert summary.aggregate(found, SMALL)["mean"]["value"] == 1


def test_sample_efficiency_by_hand() -> None:
    def rows(*errors: float | None) -> dict[str, Any]:
        return {"curve": [{"timesteps": 10 * i, "tail_rms": e, "return": 0.0} for i, e in enumerate(errors, 1)]}

    curves = [learning_curves.curve(rows(*e)) for e in ((None, 5.0, 1.0), (8.0, 3.0, 0.5, 0.1))]
    found = learning_curves.aggregate(curves, 1.0, reps=50)
    assert found is not None
    assert (found["timesteps"], found["value"], found["high"]) == ([10, 20, 30], [None, 4, 0.75], [None, 5, 1])
    assert found["reached"] == {"1": 30, "3": 30, "10": 20, "100": 20}
    for bad in ({}, {"curve": "x"}, {"curve": [1]}, {"curve": [{"timesteps": True, "tail_rms": 1.0}]}, rows(-1.0)):
        assert learning_curves.curve(bad) == {}
    assert learning_curves.aggregate([{}], 1.0, reps=50) is None


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "∞"), (0, "0.0"), (1.0, "1.0"), (-0.398, "-0.40"), (1.73e-3, "1.7e-3"), (45.2, "45"), (99.7, "100"), (1234, "1.2e3")],
)  # fmt: skip
def test_numbers(value: float | None, shown: str) -> None:
    assert text.number(value) == shown


# -- what is written --------------------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """All tags and attributes of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: dict[str, set[str]] = {}
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            self.attributes.setdefault(name, set()).add(value or "")

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison with labels, folders and files by an enemy."""
    folder = tmp_path_factory.mktemp("comparison")
    curve = [{"timesteps": 10, "tail_rms": 0.5}, {"timesteps": 20, "tail_rms": None}]
    paths = [
        save(
            folder / f"<img src=x onerror=alert({i})>", i, 0.2, curve=curve, note=HOSTILE, versions={"python": HOSTILE}
        )
        for i in range(2)
    ]
    policy = f"{HOSTILE}=ppo:{','.join(map(str, paths))}"
    compare.main(arguments(folder, "mfc", policy, f"zero=ppo:{save(folder / 'z', 3, 0.0)}"))
    return folder / "out"


def test_data_are_finite_and_complete(written: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    data = json.loads((written / "results.json").read_text(), parse_constant=refuse)
    assert data["format"] == "mfc-gym comparison 1"
    assert data["seeds"] == {"first": 0, "episodes": 4}
    assert [one["runs"] for one in data["policies"]] == [1, 2, 1]
    assert [shift["name"] for shift in data["shifts"]] == ["in-distribution", "slower"]
    assert set(data["provenance"]) == {"command", "commit", "versions", "machine"}
    rows = list(csv.DictReader((written / "scores.csv").read_text().splitlines()))
    assert len(rows) == 2 * 4 * 4
    for shift in data["shifts"]:
        for policy in shift["policies"]:
            own = [r for r in rows if (r["shift"], r["policy"]) == (shift["name"], policy["label"])]
            median = np.median([float(r["tail_rms"]) for r in own])
            assert policy["metrics"]["tail_rms"]["median"]["value"] == summary.number(median)
            assert policy["metrics"]["escaped"]["episodes"] == len(own)
    assert {path.suffix for path in written.iterdir()} == {".json", ".csv", ".md", ".html", ".png"}


def test_the_page_runs_nothing_and_loads_nothing(written: Path) -> None:
    page = (written / "comparison.html").read_text()
    parser = Tags()
    parser.feed(page)
    assert not parser.tags & {"script", "iframe", "object", "embed", "link", "a", "form", "base", "svg"}
    assert not any(name.startswith("on") for name in parser.attributes)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in parser.attributes["src"])
    assert "href" not in parser.attributes
    assert "default-src 'none'" in page
    assert HOSTILE in parser.text  # the label itself, as text
    assert "alert(1)>" in parser.text  # the folder's name


def test_markdown_holds_no_html_and_keeps_its_columns(written: Path) -> None:
    lines = (written / "comparison.md").read_text().splitlines()
    assert not any("<" in line for line in lines)
    assert {line.replace("\\|", "").count("|") for line in lines if line.startswith("|")} == {5}


def test_copies_of_an_episode_have_no_interval(tmp_path: Path) -> None:
    compare.main(arguments(tmp_path, "mfc", "matched-only", scenario="paper"))
    written = (tmp_path / "out" / "comparison.md").read_text()
    assert (
        "All episodes are the same, so there are no intervals over them: in distribution; sampling half as fast."
        in written
    )
    assert "[" not in written


def test_a_rerun_is_the_same_and_another_seed_agrees(tmp_path: Path) -> None:
    """Two independent 95 % intervals of one number overlap but for 6 of 1000 cases: 2.8 standard deviations."""

    def run(seed: int) -> dict[str, Any]:
        args = arguments(tmp_path, "mfc", "matched-only", seed=seed, episodes=64, horizon=4.0)
        return comparison_data.data(compare.play(args, *compare.checked(args), Progress(disable=True)), SMALL)

    one, again, other = run(0), run(0), run(1000)
    assert one == again
    for a, b in zip(one["shifts"], other["shifts"], strict=True):
        for p, q in zip(a["policies"], b["policies"], strict=True):
            for metric in ("tail_rms", "return"):
                x, y = (policy["metrics"][metric]["iqm"] for policy in (p, q))
                assert x["low"] <= y["high"]
                assert y["low"] <= x["high"]


BAD: list[tuple[Callable[[Path], tuple[tuple[str, ...], dict[str, Any]]], str]] = [
    (lambda path: ((), {}), "`policies` must name at least one"),
    (lambda path: (("nobody",), {}), "`name` must be one of"),
    (lambda path: (("mfc", "mfc"), {}), "`policies` must have labels of their own"),
    (lambda path: (("ppo:nowhere/*",), {}), "`policies` must name folders of agents, got none at nowhere"),
    (lambda path: (("ppo:",), {}), "`policies` must name each agent once, got none"),
    (lambda path: ((f"ppo:{save(path / 'a', 0)},{path / 'a'}",), {}), "`policies` must name each agent once"),
    (lambda path: (("mfc",), {"against": "ppo"}), "`against` must be one of the policies mfc, got ppo"),
    (lambda path: (("mfc",), {"shifts": ("wild",)}), "`shifts` must be among in-distribution, .*, got wild"),
    (lambda path: (("mfc",), {"episodes": 0}), "`episodes` must be at least 1, got 0"),
    (lambda path: (("mfc",), {"reps": 0}), "`reps` must be at least 1, got 0"),
    (lambda path: (("mfc",), {"seed": 2**29}), "`seed` must leave the seeds from 2.29 on to training"),
]


@pytest.mark.parametrize(("case", "message"), BAD)
def test_errors_write_nothing(case: Callable[[Path], Any], message: str, tmp_path: Path) -> None:
    named, options = case(tmp_path)
    with pytest.raises(ValueError, match=message):
        compare.main(arguments(tmp_path, *named, **options))
    assert not [path for path in (tmp_path / "out").glob("*") if path.is_file()]


def test_the_command_answers_errors_in_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "compare.py"), "mfc", "--dt", "-1", "--out", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 2
    assert "`dt` must be positive" in result.stderr
    assert "Traceback" not in result.stderr
