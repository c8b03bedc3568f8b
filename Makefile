# `make` lists the targets. Everything that is installed goes into .venv and .tools, in this folder.

PYTHON ?= $(firstword $(foreach python,python3.11 python3.12 python3.13 python3,\
	$(shell $(python) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(python))))
UV ?= $(or $(shell command -v uv),.tools/bin/uv)
UV_VERSION := 0.13.8

TASK ?= HalfCheetah-v4
ALGORITHM ?= csac
STEPS ?= 60000
SEEDS ?= 2
ARGS ?=

SETUP := .venv/.installed
PEERS := .venv-peers/.installed
PARL := .venv-parl/.installed
CUDA := .venv/.cuda

define require_python
@test -n "$(PYTHON)" || { echo "csac needs Python 3.11 or newer: make setup PYTHON=/path/to/python"; exit 2; }
endef

.PHONY: help setup train test slow chaos check lock clean peers bench limit growth gpu

help:  ## List the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "  make %-8s %s\n", $$1, $$2 }'

setup: $(SETUP)  ## Install csac and its exact dependencies into .venv
	@echo "csac is ready: .venv/bin/csac --help, or make train"

train: $(SETUP)  ## Train a controller: make train TASK=HalfCheetah-v4 SEEDS=2 STEPS=60000 ALGORITHM=csac ARGS=
	.venv/bin/csac train $(TASK) --algorithm $(ALGORITHM) --seeds $(SEEDS) --steps $(STEPS) $(ARGS)

test: $(SETUP)  ## Run the tests: make test ARGS='-k cli'
	.venv/bin/pytest --numprocesses logical --dist loadfile -m 'not slow' $(ARGS)

slow: $(SETUP)  ## Run the tests that need longer: processes that are killed, clusters, browsers
	.venv/bin/pytest -m slow $(ARGS)

chaos: $(SETUP)  ## Kill runs 100 times and compare what they leave, 20 minutes: make chaos ARGS='--kills 12'
	.venv/bin/python tests/support/chaos.py --out results/reliability $(ARGS)

check: $(SETUP)  ## Check format, lint, types and the direction of imports
	.venv/bin/ruff format --check --exclude '*.md' .
	.venv/bin/ruff check .
	.venv/bin/pyright
	.venv/bin/lint-imports --no-logo

peers: $(PEERS) $(PARL)  ## Install what to measure against: into .venv-peers, and PARL into .venv-parl

bench: $(SETUP) $(if $(PEERS_PYTHON),,$(PEERS)) $(if $(PARL_PYTHON),,$(PARL))  ## Measure speed beside the peers: make bench ARGS=--quick
	.venv/bin/python -m benchmarks peers --write $(ARGS)

limit: $(SETUP)  ## Measure how near training comes to the machine's limit: make limit ARGS='--repetitions 1'
	.venv/bin/python -m benchmarks limit --write $(ARGS)

growth: $(SETUP)  ## Measure what seeds, widths, batches, observations and replays cost
	.venv/bin/python -m benchmarks growth --write $(ARGS)

gpu: $(SETUP) $(if $(shell command -v nvidia-smi),$(CUDA))  ## Measure training on a GPU, and compare its numbers with the CPU's: docs/gpu.md
	.venv/bin/python -m benchmarks gpu --write $(ARGS)

lock: $(UV)  ## Compile requirements.lock anew from pyproject.toml
	$(UV) pip compile pyproject.toml --extra robots --extra cluster --group dev --universal --python-version 3.11 --upgrade --generate-hashes \
		--no-emit-index-url --no-annotate --no-header --quiet --output-file requirements.lock

clean:  ## Remove .venv, .tools and caches; runs stay
	rm -rf .venv .tools .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(SETUP): requirements.lock pyproject.toml | $(UV)
	$(require_python)
	@echo "Installing csac into .venv"
	@test -x .venv/bin/python || $(UV) venv --quiet --python "$$(command -v $(PYTHON))" .venv
	@$(UV) pip sync --quiet --compile-bytecode --python .venv/bin/python --require-hashes requirements.lock
	@$(UV) pip install --quiet --python .venv/bin/python --no-deps --editable .
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

# PARL's own list of dependencies cannot be installed: benchmarks/requirements-parl.txt is complete, and says why.
$(PARL): benchmarks/requirements-parl.txt
	$(require_python)
	@echo "Installing PARL into .venv-parl"
	@test -x .venv-parl/bin/python || $(PYTHON) -m venv .venv-parl
	@if .venv-parl/bin/python -m pip install --quiet --no-deps --requirement $<; then touch $@; \
		else echo "PARL cannot be installed here; the benchmark leaves it out"; fi

.tools/bin/uv:
	$(require_python)
	@echo "Installing uv $(UV_VERSION) into .tools"
	@$(PYTHON) -m venv .tools
	@.tools/bin/python -m pip install --quiet uv==$(UV_VERSION)
