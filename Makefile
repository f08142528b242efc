# Everything runs in .venv, which `make install` prepares once with the versions of constraints.txt.
PYTHON ?= $(shell command -v python3.12 || command -v python3 || command -v python)
BIN := .venv/bin
ARGS ?=
EXTRAS := sim,vision,lerobot,vla,minari,ray,docs,dev
PLUGIN := plugins/lerobot_policy_warmprior

# GR00T N1.5 is only in lerobot 0.5.1, which needs a separate environment.
GROOT := .venv-groot
GROOT_NEEDS := tests/lerobot/groot_n15.txt

CHECK_PYTHON := $(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] < (3, 12))' || \
	{ echo "warmprior needs Python 3.12 or newer: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)"; exit 1; }

# uv installs in a quarter of pip's time; pip brings it where it is missing, and takes over where it fails.
UV := $(or $(shell command -v uv),$(BIN)/uv)
PACKAGES := --quiet --constraint constraints.txt
define INSTALL
	$(PYTHON) -m venv .venv
	@[ -x "$(UV)" ] || $(BIN)/python -m pip install --quiet uv || true
	$(UV) pip install --python $(BIN)/python $(PACKAGES) $(1) || $(BIN)/python -m pip install $(PACKAGES) $(1)
endef

# Without bytecode every process compiles all packages again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install benchmark throughput gpu test test-slow test-ulp test-core test-groot-n15 latest lint fuzz results docs dist clean

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt $(PLUGIN)/pyproject.toml
	@$(CHECK_PYTHON)
	$(call INSTALL,--editable ".[$(EXTRAS)]")
	$(BIN)/python -m pip install --quiet --no-deps --editable $(PLUGIN)
	@touch $@

# The benchmark needs few of the packages.
.venv/simulator: pyproject.toml constraints.txt
	@$(CHECK_PYTHON)
	$(call INSTALL,--editable ".[sim]")
	@touch $@

benchmark: $(if $(wildcard .venv/installed),install,.venv/simulator)
	$(BIN)/python benchmarks/robomimic.py $(ARGS)

throughput: install
	$(BIN)/python benchmarks/throughput.py $(ARGS)

# The parts that need a GPU: make gpu PART=2, or all. Finished parts are skipped.
gpu: install
	$(BIN)/python benchmarks/gpu.py $(if $(PART),--part $(PART)) $(ARGS)

# Bytecode is written even where the environment says no: the tests' processes would compile all again.
test test-slow test-ulp: export PYTHONDONTWRITEBYTECODE :=

# A process per core; tests of one file share a process, and the policies that they train.
PYTEST := $(BIN)/python -m pytest -n logical --dist loadfile

test: install
	$(PYTEST) -m "not slow" $(ARGS)

# Slow tests: the built documentation, the wheel in an empty environment, long trainings.
test-slow: install
	$(PYTEST) -m slow $(ARGS)

# The suite on a processor whose products depend on the number of rows in their last bits.
test-ulp: install
	PYTHONPATH=$(CURDIR)/tests/rows $(PYTEST) -m "not slow" $(ARGS)

# Tests of the core without the simulator, on any system.
CORE := .venv-core
test-core:
	@$(CHECK_PYTHON)
	$(PYTHON) -m venv $(CORE)
	$(CORE)/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,vision]" gymnasium scipy
	$(CORE)/bin/python -m pytest -n logical --dist loadfile $(addprefix tests/,modules objectives transforms diagnostics rl) $(ARGS)

$(GROOT)/installed: pyproject.toml constraints.txt $(GROOT_NEEDS)
	$(PYTHON) -m venv $(GROOT)
	$(GROOT)/bin/python -m pip install --quiet --upgrade pip
	awk -F== 'NR == FNR { if (NF > 1) own[$$1]; next } !($$1 in own)' $(GROOT_NEEDS) constraints.txt > $(GROOT)/constraints.txt
	$(GROOT)/bin/python -m pip install --quiet --constraint $(GROOT)/constraints.txt --requirement $(GROOT_NEEDS) --editable .
	$(GROOT)/bin/python -m pip install --quiet --no-deps lerobot==0.5.1
	@touch $@

test-groot-n15: $(GROOT)/installed
	$(GROOT)/bin/python -m pytest tests/lerobot/test_ports.py tests/lerobot/test_groot_n15.py $(ARGS)

# Tests with the newest packages that pyproject.toml admits, without constraints.txt.
LATEST := .venv-latest
latest:
	$(PYTHON) -m venv $(LATEST)
	$(LATEST)/bin/python -m pip install --quiet --upgrade pip
	$(LATEST)/bin/python -m pip install --quiet --upgrade --editable ".[$(EXTRAS)]"
	$(LATEST)/bin/python -m pip install --quiet --no-deps --editable $(PLUGIN)
	$(LATEST)/bin/python -m pytest -n logical --dist loadfile -m "not slow" $(ARGS)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

fuzz: install
	$(BIN)/python -W ignore -m tests.fuzz $(ARGS)

# Charts and tables of the results pages, from docs/results, and the diagrams.
results: install
	PYTHONPATH=benchmarks $(BIN)/python docs/figures/results.py
	PYTHONPATH=benchmarks $(BIN)/python docs/figures/leaderboard.py
	$(BIN)/python docs/figures/diagrams.py

docs: install
	$(BIN)/sphinx-build -W -q -b html -d build/doctrees $(ARGS) docs docs/_build

# Wheel and sdist of the library and of the plugin, in dist/. A release is the tag v and the version: make dist TAG=v0.2.0.
VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
dist:
	@test "$(or $(TAG),v$(VERSION))" = "v$(VERSION)" || \
		{ echo "the tag $(TAG) is not v$(VERSION), the version in pyproject.toml"; exit 1; }
	$(PYTHON) -m venv build/dist
	build/dist/bin/python -m pip install --quiet "hatchling>=1.25"
	build/dist/bin/python -m hatchling build -d dist
	cd $(PLUGIN) && $(CURDIR)/build/dist/bin/python -m hatchling build -d $(CURDIR)/dist

clean:
	rm -rf .venv $(CORE) $(GROOT) $(LATEST) docs/_build docs/auto_tutorials build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
