# On a machine with Python (3.11 or newer), pip, make and git.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PYTEST := $(BIN)/python -m pytest --numprocesses 2 --dist loadfile
export RAY_USAGE_STATS_ENABLED := 0
export MLFLOW_DISABLE_TELEMETRY := true
# Without its cache every process compiles the code and the tests anew: a third of the time before the first test.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: bench chaos clean demo docs format help install lint oracle test test-fast types

help:  ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: install  ## a population of two in the cramped room, with its SP/XP matrix
	$(BIN)/popgen run env=overcooked/cramped_room scale=demo seed=1 run.id=demo

test: install  ## all tests
	$(PYTEST)

test-fast: install  ## without Ray and whole runs (the oracle plays 2,000 steps of each layout, not 20,000)
	POPGEN_ORACLE_STEPS=2000 $(PYTEST) -m "not ray and not end_to_end"

lint: install docs types  ## style, types and documentation
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install  ## pyright: basic, strict where pyproject.toml says so
	$(BIN)/basedpyright

docs: install  ## the documentation as a site, in site/; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

format: install  ## rewrite the code as `make lint` wants it
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

oracle: install  ## every layout and cooking mode against overcooked_ai, 20,000 steps each
	$(BIN)/python -m pytest tests/envs -k oracle

bench: install  ## steps per second of the simulator
	$(BIN)/popgen bench env --json

chaos: install  ## random faults on small runs: each must end as if nothing had happened
	$(BIN)/python tests/chaos/campaign.py

install: $(STAMP)  ## the virtual environment

# Runs again only when the dependencies may have changed; the code itself is installed in place.
$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev,docs]'
	touch $@

clean:  ## remove what is built
	rm -rf $(VENV) .pytest_cache .ruff_cache build dist site *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
