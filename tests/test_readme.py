"""Every fenced block of the README runs, and every Python block of docs/uncertainty.md."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
DOCUMENTED = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/uncertainty.md").read_text(), re.MULTILINE | re.DOTALL)
PYTHON = [block for language, block in BLOCKS if language == "python"] + DOCUMENTED
COMMANDS = [
    line.split("  #")[0].strip()
    for language, block in BLOCKS
    if language == "sh"
    for line in block.splitlines()
    if line.strip()
]


def test_only_known_languages() -> None:
    assert {language for language, _ in BLOCKS} <= {"python", "sh"}
    assert len(PYTHON) >= 2


@pytest.mark.parametrize("block", PYTHON)
def test_python_blocks_print_what_they_say(block: str) -> None:
    """Numbers in trailing comments agree to the two digits printed."""
    result = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, cwd=ROOT, check=True)
    promised = [float(value) for value in re.findall(r"print\(.*\)  # ([0-9.e+-]+)", block)]
    assert [float(value) for value in result.stdout.split()] == pytest.approx(promised, rel=0.05)


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("python ")])
def test_commands_run(command: str, tmp_path: Path) -> None:
    words = [sys.executable, *command.split()[1:]]
    if "--out" in words:
        words[words.index("--out") + 1] = str(tmp_path)
    result = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env={**os.environ, "COLUMNS": "120"})
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip()


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("make ")])
def test_make_targets_exist(command: str) -> None:
    subprocess.run(["make", "--dry-run", command.split()[1]], cwd=ROOT, capture_output=True, check=True)


def test_linked_files_exist() -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text())
    assert links
    assert all((ROOT / link).is_file() for link in links)
