"""The commands as a user calls them: results on disk, and errors before anything is written."""

import csv
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from rich.console import Console
from rich.text import Text

from baselines import tables
from scripts import benchmark, evaluate_controller

ROOT = Path(__file__).parents[1]


def evaluate(*controllers: str, **options: object) -> None:
    evaluate_controller.main(evaluate_controller.Arguments(controllers, **options))  # type: ignore[arg-type]


def test_evaluation_writes_results_that_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate("mfc", "matched-only", scenario="random", episodes=3, seed=7, exact=1, horizon=4.0, out=tmp_path)
    data = json.loads((tmp_path / "results.json").read_text())
    rows = list(csv.DictReader((tmp_path / "results.csv").read_text().splitlines()))
    assert [(row["controller"], row["seed"]) for row in rows] == [
        (c, str(s)) for c in ("mfc", "matched-only") for s in (7, 8, 9)
    ]
    assert data["seeds"] == [7, 8, 9]
    for result, cut in zip(data["results"], (rows[:3], rows[3:]), strict=True):
        for episode, row in zip(result["episodes"], cut, strict=True):
            assert {k: float(row[k]) for k in ("iae", "tail_rms")} == {k: episode[k] for k in ("iae", "tail_rms")}
    assert set(data["provenance"]) == {"command", "commit", "versions", "machine"}
    assert {"numpy", "gymnasium", "numba"} <= set(data["provenance"]["versions"])
    assert (tmp_path / "episode.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "tail rms" in printed
    assert "mfc" in printed


WITHOUT_EXTRAS = """
import runpy, sys
class Missing:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in ("torch", "stable_baselines3", "sb3_contrib", "safetensors", "minari", "h5py"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
""".strip()
COMMANDS = sorted(path for path in (ROOT / "scripts").glob("*.py") if "tyro" in path.read_text())


@pytest.mark.parametrize("script", COMMANDS, ids=lambda path: path.stem)
def test_help_shows_every_example_on_its_own_line(script: Path) -> None:
    """Also where an extra is missing."""
    run = f"{WITHOUT_EXTRAS}\nsys.argv = ['script', '--help']; runpy.run_path({str(script)!r}, run_name='__main__')"
    result = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, check=True, cwd=ROOT)
    lines = [line.strip() for line in result.stdout.splitlines()]
    examples = [line.strip() for line in script.read_text().split('"""')[1].splitlines() if "python " in line]
    assert examples
    assert [line for line in lines if line in examples] == examples
    assert not any("  " in line for line in examples)


@pytest.mark.parametrize(("script", "extra"), [("train_rl", "rl"), ("record_episodes", "interop")])
def test_a_missing_extra_is_named(script: str, extra: str, tmp_path: Path) -> None:
    argument = "ppo" if script == "train_rl" else "mfc"
    path = ROOT / "scripts" / f"{script}.py"
    run = f"{WITHOUT_EXTRAS}\nsys.argv = ['script', {argument!r}]; runpy.run_path({str(path)!r}, run_name='__main__')"
    result = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 2
    assert f'is not installed, run `pip install -c constraints.txt -e ".[{extra}]"`' in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("width", [60, 80, 200])
def test_tables_cut_nothing(width: int) -> None:
    """Headings that differ at their end stay apart; every number is whole; no line is wider than the terminal."""
    headings = [f"ppo:results/ppo-{i}/best" for i in range(7)]
    numbers = [f"{i}.2345e-05 [0.000{i}, 0.00123]" for i in range(7)]
    columns = [tables.Column(h, [tables.number(n)]) for h, n in zip(headings, numbers, strict=True)]
    console = Console(width=width, file=io.StringIO())
    tables.side_by_side(console, "title", [tables.Column("metric", [Text("settling time")])], columns)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in printed
    assert all(number in printed for number in numbers)
    assert all(heading in printed for heading in headings)
    assert max(map(len, printed.splitlines())) <= width


def test_long_headings_fold() -> None:
    console = Console(width=80, file=io.StringIO())
    tables.side_by_side(
        console, "", [tables.Column("", [Text("a")])], [tables.Column("x" * 40, [tables.number("1.5")])]
    )
    assert console.file.getvalue().count("x") == 40  # type: ignore[attr-defined]


def test_evaluation_is_reproducible_and_order_free(tmp_path: Path) -> None:
    """Each policy sees the same episodes, whatever else is evaluated and in which order."""
    results = []
    for controllers in (("mfc", "single-loop"), ("single-loop", "mfc")):
        evaluate(*controllers, scenario="random", episodes=2, horizon=2.0, exact=0, out=tmp_path)
        found = json.loads((tmp_path / "results.json").read_text())["results"]
        results.append({r["controller"]: [e["iae"] for e in r["episodes"]] for r in found})
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "`controllers` must name at least one"),
        (("nobody",), "`name` must be one of"),
        (("mfc:gain",), "name:option=value"),
        (("mfc:gain=largest",), "`gain` must be one of"),
        (("mfc:colour=3",), "does not take these options"),
        (("mfc", "--scenario", "wild"), "`scenario` must be one of"),
        (("mfc", "--env", "mfc_gym/Nothing-v0"), "Nothing"),
        (("mfc", "--env", "Pendulum-v1"), "`env` must be an environment of mfc_gym"),
        (("mfc", "--env", "no_module:Some-v0"), "`no_module` must be a module"),
        (("math:sin:pole=1",), "controller 'math:sin' does not take these options"),
        (("math:sine",), "which has no 'sine' to call"),
        (("math:pi",), "which has no 'pi' to call"),
        (("mfc", "--dt", "-1"), "`dt` must be positive"),
        (("mfc", "--episodes", "0"), "`episodes` must be at least 1"),
        (("mfc", "--actuator", "lag"), "`actuator` must be option=value,..., got 'lag'."),
        (("mfc", "--exact", "-1"), "`exact` must be at least 0"),
        (("mfc", "--horizon", "0.01"), "`horizon` must be at least 2 dt"),
        (("mfc", "--sweep", "0.01", "0.03"), "`horizon` must be a multiple of `dt`"),
        (("mfc", "--theta", "0.9", "0.9"), "`theta` must keep"),
        (("mfc", "--out", "/proc/results"), "`out` must be a folder that can be written"),
    ],
)
def test_errors_are_one_sentence_and_write_nothing(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "new")]
    command = [sys.executable, str(ROOT / "scripts" / "evaluate_controller.py"), *arguments, *out]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


OWN = """
from baselines.controller import Controller

class Zero(Controller):
    name, memory_size = "zero", 0

    def __init__(self, nominal, level=0.0):
        self.nominal, self.level = nominal, level

    def control(self, observations, memory, fresh):
        return 0.0 * observations[:, 0] + self.level
"""


def test_a_controller_and_a_plant_of_your_own(tmp_path: Path) -> None:
    """Found in the working directory, by the module that defines or registers them."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "plants.py").write_text(
        "from dataclasses import replace\n\nimport mfc_gym\nfrom mfc_gym.plant import build_system\n\n"
        "mfc_gym.register_system('Mine', replace(build_system('Duffing', {}), name='Mine'))\n"
    )
    command = [sys.executable, str(ROOT / "scripts" / "evaluate_controller.py"), "own:Zero", "own:Zero:level=0.5"]
    more = ["--env", "plants:mfc_gym/Mine-v0", "--horizon", "1", "--out", "out"]
    result = subprocess.run([*command, *more], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    found = json.loads((tmp_path / "out" / "results.json").read_text())["results"]
    assert [one["controller"] for one in found] == ["own:Zero", "own:Zero:level=0.5"]
    assert [one["episodes"][0]["peak"] for one in found] == [0.0, 0.5]


def test_copies_of_an_episode_have_no_interval(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate("mfc", episodes=3, horizon=1.0, exact=0, out=tmp_path)
    printed = capsys.readouterr().out
    assert "all episodes are the same" in printed
    assert "[" not in printed


def test_a_benchmark_without_cases_is_refused() -> None:
    with pytest.raises(ValueError, match="`cases` must be at least 1, got 0"):
        benchmark.main(benchmark.Sampled(cases=0))


def test_a_measurement_that_needs_an_extra_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> list[Any]:
        raise gym.error.DependencyNotInstalled("run `pip install [rl]`")

    monkeypatch.setattr(benchmark, "MEASUREMENTS", {"sb3": missing, "exact": lambda: [("solution", 0.25, "s", 0.5)]})
    benchmark.main(benchmark.Speed())
    printed = capsys.readouterr().out
    assert "left out: run `pip install [rl]`" in printed
    assert "0.25" in printed
