# `make` lists the targets. Everything that is installed goes into .venv and .tools, in this folder.

PYTHON ?= $(firstword $(foreach python,python3.11 python3.12 python3.13 python3,\
	$(shell $(python) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(python))))
UV ?= $(or $(shell command -v uv),.tools/bin/uv)
UV_VERSION := 0.13.8

TASK ?= HalfCheetah-v4
ALGORITHM ?= sac
PRESET ?= $(if $(filter csac sac,$(ALGORITHM)),strong)
STEPS ?= 30000
SEEDS ?= 1
ARGS ?=

# A Python that is not that of .venv gets an environment of its own: make test PYTHON=python3.13 tests in .venv-3.13.
version = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
ifeq ($(origin PYTHON) $(wildcard .venv/bin/python),command line .venv/bin/python)
ASKED := $(or $(call version,$(PYTHON)),$(error $(PYTHON) does not run: give the path of a Python 3.11 or newer))
OTHER := $(filter-out $(call version,.venv/bin/python),$(ASKED))
endif
VENV := .venv$(addprefix -,$(OTHER))

SETUP := $(VENV)/.installed
PEERS := .venv-peers/.installed
CUDA := .venv/.cuda

define require_python
@test -n "$(PYTHON)" || { echo "csac needs Python 3.11 or newer: make setup PYTHON=/path/to/python"; exit 2; }
endef

.PHONY: help setup train test slow chaos results format check docs lock clean peers bench limit growth gpu

help:  ## List the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "  make %-8s %s\n", $$1, $$2 }'

setup: $(SETUP)  ## Install csac and its exact dependencies into .venv
	@echo "csac is ready: $(VENV)/bin/csac --help, or make train"

train: $(SETUP)  ## Train a controller: make train TASK=HalfCheetah-v4 SEEDS=1 STEPS=30000 ALGORITHM=sac PRESET=strong ARGS=
	$(VENV)/bin/csac train $(TASK) --algorithm $(ALGORITHM) $(addprefix --preset ,$(PRESET)) --seeds $(SEEDS) --steps $(STEPS) $(ARGS)

test: $(SETUP)  ## Run the tests: make test ARGS='-k cli'
	$(VENV)/bin/pytest --numprocesses logical --dist loadfile --no-loadscope-reorder -m 'not slow' $(ARGS)

slow: $(SETUP)  ## Run the tests that need longer: learning, fixed-seed digests, kills, clusters
	$(VENV)/bin/pytest --numprocesses logical --dist loadfile -m slow $(ARGS)

chaos: $(SETUP)  ## Kill runs 100 times and compare what they leave: make chaos ARGS='--kills 25'
	.venv/bin/python tests/support/chaos.py --out results/reliability $(ARGS)

results: $(SETUP)  ## Write the tables and pictures of results/ from the CSVs there
	$(VENV)/bin/python results/make.py

format: $(SETUP)  ## Put the code into its format, and mend what ruff can mend
	$(VENV)/bin/ruff format --exclude '*.md' .
	$(VENV)/bin/ruff check --fix .

check: $(SETUP)  ## Check format, lint, types and the direction of imports
	$(VENV)/bin/ruff format --check --exclude '*.md' .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python
	$(VENV)/bin/lint-imports --no-logo

docs: $(SETUP)  ## Make the site, with the reference from the docstrings: site/index.html
	$(VENV)/bin/sphinx-apidoc -q --force --remove-old --no-toc --templatedir docs/site/templates --output-dir docs/reference csac csac/__main__.py
	$(VENV)/bin/sphinx-build -q --fail-on-warning --keep-going --jobs auto -c docs/site -d site/.doctrees . site
	@echo "The site is ready: site/index.html"

peers: $(PEERS)  ## Install SB3 and SBX, to measure against, into .venv-peers

bench: $(SETUP) $(if $(PEERS_PYTHON),,$(PEERS))  ## Measure speed beside the peers: make bench ARGS=--quick
	.venv/bin/python -m benchmarks peers --write $(ARGS)

limit: $(SETUP)  ## Measure how near training comes to the machine's limit: make limit ARGS='--repetitions 1'
	.venv/bin/python -m benchmarks limit --write $(ARGS)

growth: $(SETUP)  ## Measure what seeds, widths, batches, observations and replays cost
	.venv/bin/python -m benchmarks growth --write $(ARGS)

gpu: $(SETUP) $(if $(shell command -v nvidia-smi),$(CUDA))  ## Measure training on a GPU, and compare its numbers with the CPU's: docs/gpu.md
	.venv/bin/python -m benchmarks gpu --write $(ARGS)

lock: $(UV)  ## Compile requirements.lock anew from pyproject.toml, for Python 3.11 and newer
	$(UV) pip compile pyproject.toml --extra cluster --extra onnx --extra robots --extra tune --extra wandb --group dev --universal \
		--python-version 3.11 --upgrade --generate-hashes \
		--no-emit-index-url --no-annotate --no-header --quiet --output-file requirements.lock

clean:  ## Remove environments, the site and caches; runs stay
	rm -rf .venv .venv-3.* .tools site docs/reference .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(SETUP): requirements.lock pyproject.toml | $(UV)
	$(require_python)
	@echo "Installing csac into $(VENV)"
	@test -x $(VENV)/bin/python || $(UV) venv --quiet --python "$$(command -v $(PYTHON))" $(VENV)
	@$(UV) pip sync --quiet --compile-bytecode --python $(VENV)/bin/python --require-hashes requirements.lock
	@$(UV) pip install --quiet --python $(VENV)/bin/python --no-deps --editable .
	@touch $@

$(CUDA): $(SETUP)
	@echo "Installing JAX for CUDA into .venv"
	@$(UV) pip install --quiet --python .venv/bin/python --editable '.[cuda]'
	@touch $@

$(PEERS): benchmarks/requirements-peers.txt
	$(require_python)
	@echo "Installing the peers into .venv-peers"
	@test -x .venv-peers/bin/python || $(PYTHON) -m venv .venv-peers
	@.venv-peers/bin/python -m pip install --quiet --requirement $<
	@touch $@

.tools/bin/uv:
	$(require_python)
	@echo "Installing uv $(UV_VERSION) into .tools"
	@$(PYTHON) -m venv .tools
	@.tools/bin/python -m pip install --quiet uv==$(UV_VERSION)
