# On a machine with Python (3.11 or newer), pip, make and git.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export RAY_USAGE_STATS_ENABLED := 0
export MLFLOW_DISABLE_TELEMETRY := true

.PHONY: chaos demo test lint format oracle bench install clean

demo: install  ## a population of two in the cramped room, with its SP/XP matrix
	$(BIN)/popgen run env=overcooked/cramped_room scale=demo seed=1

test: install
	$(BIN)/python -m pytest

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

oracle: install  ## every layout and cooking mode against overcooked_ai, 20,000 steps each
	$(BIN)/python -m pytest tests/envs -k oracle

bench: install
	$(BIN)/popgen bench env --json

chaos: install  ## random faults on small runs: each must end as if nothing had happened
	$(BIN)/python tests/chaos/campaign.py

install: $(STAMP)

# Runs again only when the dependencies may have changed; the code itself is installed in place.
$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache build dist *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
