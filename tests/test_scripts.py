"""The commands as a user calls them: results on disk, and errors before anything is written."""

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

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
        (("math:sine",), "which has no 'sine'"),
        (("mfc", "--dt", "-1"), "`dt` must be positive"),
        (("mfc", "--episodes", "0"), "`episodes` must be at least 1"),
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
