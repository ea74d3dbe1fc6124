SHELL = /bin/sh
PYTHON ?= python3
VENV = .venv
BIN = $(VENV)/bin
SOURCES = sb3_cchain benchmarks tests
SUITE = gym_control
# What the demo needs: its own extra and, elsewhere than in Gym Control, that of the suite. `dev` holds all of them
DEMO_EXTRAS = $(if $(wildcard $(VENV)/.installed-dev),dev,$(if $(filter gym_control,$(SUITE)),demo,demo,$(SUITE)))

.PHONY: demo test install pytest pytest-fast lint format check-codestyle type commit-checks doc linkcheck dist tables clean

# --- The two commands of the README -------------------------------------------------------------------------------------

demo: $(VENV)/.installed-$(DEMO_EXTRAS)
	$(BIN)/python -m benchmarks.demo --suite $(SUITE) $(ARGS)

test: lint check-codestyle type pytest

# --- Set-up: a second call installs nothing again -----------------------------------------------------------------------

install: $(VENV)/.installed-dev

$(BIN)/python:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 10))" || { echo "Python 3.10 or later is needed: make PYTHON=python3.11 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# The package with the extras that the target is named after
$(VENV)/.installed-%: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch hatchling editables
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable ".[$*]"
	@touch $@

# --- Named as in Stable-Baselines3 --------------------------------------------------------------------------------------

pytest: install
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal $(ARGS)

pytest-fast: install
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal -m "not slow" $(ARGS)

lint: install
	$(BIN)/ruff check $(SOURCES)

format: install
	$(BIN)/ruff check --select I --fix $(SOURCES)
	$(BIN)/black $(SOURCES)

check-codestyle: install
	$(BIN)/ruff check --select I $(SOURCES)
	$(BIN)/black --check --quiet $(SOURCES) || { $(BIN)/black --check $(SOURCES); exit 1; }

type: install
	$(BIN)/mypy
	$(BIN)/pyright --pythonpath $(BIN)/python

commit-checks: format type lint

doc: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W -b html docs docs/_build/html

# Needs a network
linkcheck: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -q -b linkcheck docs docs/_build/linkcheck

dist: $(VENV)/.installed-release
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/twine check --strict dist/*

# Anew from the committed results: the reports, and the tables and pictures of the pages
tables: install
	$(BIN)/python -m benchmarks.report --budget reduced paper
	$(BIN)/python -m benchmarks.readme --write
	$(BIN)/python -m benchmarks.family --write
	$(BIN)/python -m benchmarks.plasticity --write
	$(BIN)/python -m benchmarks.sensitivity --write
	$(BIN)/python -m benchmarks.supervised --write
	$(BIN)/python -m benchmarks.shelf --write

clean:
	rm -rf $(VENV) build dist docs/_build .mypy_cache .pytest_cache .ruff_cache
