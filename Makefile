# make run      environment, install, the whole chain on a campaign; results and the page in results/
# make test     unit tests and the chain end to end
# make lint     ruff, mypy, and the directions of imports
# make bench    benchmarks: ratios, side by side in one run
# make study    long statistical studies; tables in studies/tables
# make docs     docs/commands.md and the pages of effects, from the code
# make figures  pictures and the table of errors of the README, from the results of the sample campaign; import graph
#
# Your own campaign: make run CAMPAIGN=path/to/folder (its *.h5 run files, and its geometry.yaml beside them).
# `make run` calls `balance run`, which needs no clone of this repository.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
BALANCE := $(BIN)/balance

CAMPAIGN ?= sample_data
# Of another campaign, `balance run` finds the geometry in its folder.
GEOMETRY ?= $(if $(filter sample_data,$(CAMPAIGN)),configs/rts-6.yaml)
JOBS ?= 1
RESULTS ?= results

# Many small matrices: threads in BLAS cost more than they bring.
export OPENBLAS_NUM_THREADS ?= 1
# Containers forbid to keep compiled sources: each worker and each command that a test starts would compile all of them.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run chain install test lint format bench study docs figures clean
.DELETE_ON_ERROR:

include pipeline.mk
run: install chain
chain: | install

install: $(INSTALLED)

$(INSTALLED): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

test: install
	$(BIN)/python -m pytest -n 2

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: install
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[bench]'
	$(BIN)/python -m benchmarks

study: install
	$(BIN)/python -m studies

docs: install
	$(BIN)/python tools/cli_reference.py
	$(BIN)/python tools/effect_pages.py

# Methods of the picture. Their models and responses are given, too: the labels come from these.
COMPARED := static transfer paper-full rigid closed
figures: run
	$(if $(filter sample_data,$(CAMPAIGN)),,$(error the pictures show the sample campaign: leave CAMPAIGN out))
	$(BALANCE) report $(COMPARED:%=$(RESULTS)/loads-%.h5) $(wildcard $(RESULTS)/model-*.h5) $(RESULTS)/transfer.h5 \
		-o $(RESULTS)/figures.html --picture docs/pictures/check-runs.png
	$(BIN)/python tools/error_table.py $(RESULTS)
	$(BIN)/python tools/import_graph.py
	$(BIN)/python tools/page_pictures.py $(RESULTS)/report.html

clean:
	rm -rf $(RESULTS) build dist .pytest_cache .mypy_cache .ruff_cache
