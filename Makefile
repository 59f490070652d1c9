PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test lint type format docs linkcheck clean

help:  ## Show what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/:/' | column -t -s ':'

# Set up once, and again whenever the project's requirements change: first what a user has, then what a developer needs.
$(VENV)/usable: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[extra]'
	$(BIN)/python -m sb3_knntd.kernels
	touch $@

$(VENV)/installed: $(VENV)/usable
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	$(BIN)/python -m pip check
	touch $@

demo: $(VENV)/usable  ## Train KNNTD on MountainCar-v0 and show what it learned
	$(BIN)/sb3-knntd demo

test: $(VENV)/installed  ## Run the tests
	$(BIN)/python -m pytest -n auto

lint: $(VENV)/installed  ## Check style
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(VENV)/installed  ## Check types
	$(BIN)/mypy

format: $(VENV)/installed  ## Put code into the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/installed  ## Build the documentation, docs/_build/html/index.html
	$(BIN)/python -m sphinx -W --keep-going docs docs/_build/html

linkcheck: $(VENV)/installed  ## Check the documentation's links to other sites
	$(BIN)/python -m sphinx -b linkcheck docs docs/_build/linkcheck

clean:  ## Remove what set-up and runs have made
	rm -rf $(VENV) build dist demo docs/_build docs/examples/*.ipynb *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
