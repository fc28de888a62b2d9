# Each target sets up what it needs in .venv; nothing else has to be installed but Python 3.11 and make.
PYTHON ?= python3
BIN = .venv/bin
PIP = $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: run test clean

run: .venv/installed
	$(BIN)/python scripts/evaluate_controller.py mfc single-loop matched-only --out results/evaluation
	$(BIN)/python scripts/reproduce_paper.py --out results/paper

test: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest -n auto

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) --editable .
	@touch $@

.venv/installed-test: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) --editable ".[test]"
	@touch $@ .venv/installed

clean:
	rm -rf .venv build results
