# Every target sets itself up: a virtual environment with the pinned packages of requirements.lock, in .venv.
SHELL := /bin/bash
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-stamp
OUTPUTS ?= outputs
VIEW ?=
export OMP_NUM_THREADS ?= 1
export MPLBACKEND := Agg

SCENE ?= beam

.PHONY: help setup demo sweep test smoke view report bench plan scale stability trust validate lint clean

help:  ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/:/' | column -t -s ':'

$(STAMP): requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

setup: $(STAMP)  ## virtual environment with the pinned packages

demo: $(STAMP)  ## a twin of what it has never seen before: video, recording, table; SCENE=beam or glass
	$(BIN)/python -m pipelines experiment=$(SCENE)_demo machine.outputs=$(OUTPUTS) $(ARGS)

sweep: $(STAMP)  ## both scenes and the sweeps over noise, lambda_d and passes; table, recordings, report
	$(BIN)/python -m pipelines.sweep all machine.outputs=$(OUTPUTS) $(ARGS)

test: $(STAMP)  ## all tests, two at a time
	$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

smoke: $(STAMP)  ## every *_ci experiment from end to end
	set -e; for file in conf/experiment/*_ci.yaml; do \
	  $(BIN)/python -m pipelines experiment=$$(basename $$file .yaml) machine.outputs=$(OUTPUTS) $(ARGS); \
	done

view: $(STAMP)  ## newest recording in the Rerun viewer; VIEW=web serves it to a browser, FILE=... shows another
	$(BIN)/python -m pipelines.view --outputs $(OUTPUTS) $(if $(FILE),--file $(FILE)) $(if $(filter web,$(VIEW)),--web)

report: $(STAMP)  ## one HTML page of the newest sweep in outputs/reports
	$(BIN)/python -m pipelines.report --outputs $(OUTPUTS) $(ARGS)

bench: $(STAMP)  ## speed against error of all methods, in turn; ARGS=--train for the seed's network, ARGS=--publish for docs
	$(BIN)/python -m pipelines.bench --outputs $(OUTPUTS) $(ARGS)

stability: $(STAMP)  ## hard cases by solver, network and twin (5 minutes; CASES="..." for some, CASES=ci for a few)
	$(BIN)/python -m pipelines.stability --outputs $(OUTPUTS) --cases "$(if $(filter command line,$(origin CASES)),$(CASES))" $(ARGS)

trust: $(STAMP)  ## which flags came before the error had tripled, from the rows of `make stability`, into docs/results/trust
	$(BIN)/python -m pipelines.trust --outputs $(OUTPUTS) report

plan: $(STAMP)  ## measured data of the planner anew, and its plans against clips that they do not hold (20 minutes)
	$(BIN)/python -m pipelines.plan --measure beam --outputs $(OUTPUTS)
	$(BIN)/python -m pipelines.plan --measure glass --outputs $(OUTPUTS) $(ARGS)
	$(BIN)/python -m pipelines.plan --validate --outputs $(OUTPUTS) $(ARGS)

scale: $(STAMP)  ## launchers, processes and pieces held against each other; what 10,000 jobs cost (needs a finished sweep)
	for part in launchers devices shards cost; do \
	  $(BIN)/python -m pipelines.scale $$part --outputs $(OUTPUTS) $(ARGS) || failed="$$failed $$part"; \
	done; test -z "$$failed" || { echo "not equal or not run:$$failed"; exit 1; }

CASES ?= hydrostatics viscous frequency martin_moyce faltinsen cylinder
validate: $(STAMP)  ## the liquid's ground truth against theory and recordings of real water (an hour; CASES=... for some)
	for case in $(CASES); do \
	  $(BIN)/python -m zsdt.evaluation.liquid_validation $$case $(OUTPUTS)/reports/liquid || failed="$$failed $$case"; \
	done; test -z "$$failed" || { echo "not met or not run:$$failed"; exit 1; }

lint: $(STAMP)  ## ruff and mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy zsdt pipelines

clean:  ## all that runs have written (artifacts, runs, sweeps, reports), and caches
	rm -rf $(OUTPUTS) .pytest_cache .ruff_cache .mypy_cache build *.egg-info
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
