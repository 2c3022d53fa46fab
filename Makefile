# All targets use a virtual environment in .venv with the versions of constraints.txt. It is created
# by the first target, and updated if pyproject.toml or constraints.txt change.
PYTHON ?= python3
# number of parallel test processes, with one thread each
WORKERS ?= 2
# which tests `make test` runs, as pytest's -m; empty for all
TESTS ?= not slow and not heavy
# threads of the demo: its small networks gain little from a second thread, and two threads are very
# slow if another process uses a core
THREADS ?= 1
# settings of the demo; `make demo DEMO="episodes=10 seed=1"` chooses others
DEMO ?= learner.chunk=25 episodes=54 evaluation.interval=54 evaluation.episodes=32

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/emberlink-installed
UNFINISHED := $(VENV)/emberlink-unfinished
# Python compiles a module when it is first imported; to compile all at once takes a minute.
PIP := $(BIN)/python -m pip install -q --no-compile --disable-pip-version-check -c constraints.txt
# Python keeps compiled modules, also where it is told not to, as in many containers: to compile torch takes each process
# ten seconds.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-cluster test-clients soak bench guard lint typecheck docs tables install browser clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20

demo: $(INSTALLED)  ## train a team in three minutes and evaluate it, with figures and a GIF
	@OMP_NUM_THREADS=$(THREADS) $(BIN)/emberlink train independent setup=strong $(DEMO)

# Tests of a file run in one process, since they share trainings.
test: $(INSTALLED)  ## run the tests, without the slow ones (under 4 minutes on two cores)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile -m "$(TESTS)"

test-slow: $(INSTALLED) browser  ## run the slow tests (5 to 20 minutes)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile -m "slow or heavy"

# Replays are tested in Chromium, which Debian's package installs.
browser:  ## install Chromium for test-slow if it is missing (on Debian and as root only)
	@for name in "$$EMBERLINK_BROWSER" chromium chromium-browser google-chrome; do \
		if [ -n "$$name" ] && command -v "$$name" >/dev/null; then exit 0; fi; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then echo "installing chromium" >&2; apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends chromium >/dev/null; \
	else echo "there is no Chromium: the tests of replays will fail" >&2; fi

# Files cluster_*.py, so that no other target runs them. A missing program is an error.
test-cluster: $(INSTALLED)  ## test sweeps on SLURM and Ray (15 to 40 minutes; root; docs/cluster.md)
	@$(BIN)/python -c 'import submitit, ray' 2>/dev/null || $(PIP) -e '.[slurm,ray]'
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -p no:xdist -o python_files='cluster_*.py' tests/cluster

# Each in an environment of its own, since BenchMARL needs an older torchrl.
test-clients: $(INSTALLED)  ## train with BenchMARL, Stable-Baselines3, RLlib and plain PyTorch (15 minutes)
	@mkdir -p build/clients; for client in benchmarl_page:benchmarl sb3:stable-baselines3 "rllib:ray[rllib]" ppo:pip; do \
		name=$${client%%:*}; venv=$(VENV)/clients/$$name; \
		[ -e $$venv/installed ] || { $(PYTHON) -m venv $$venv && \
			$$venv/bin/pip install -q "$$(grep '^torch==' constraints.txt)" $${client##*:} -e . && \
			touch $$venv/installed; } || exit 1; \
		python=$$PWD/$$venv/bin/python script=$$PWD/tests/clients/$$name.py; \
		(cd build/clients && OMP_NUM_THREADS=1 $$python $$script) || exit 1; done

soak: $(INSTALLED)  ## kill, interrupt and damage trainings repeatedly (about half an hour)
	@OMP_NUM_THREADS=1 $(BIN)/python tests/soak/soak.py $(SOAK)
	@OMP_NUM_THREADS=1 EMBERLINK_SOAK=1 $(BIN)/python -m pytest -q -n $(WORKERS) \
		tests/envs/test_invariants.py tests/trainers/config/test_config_fuzz.py

bench: $(INSTALLED)  ## run the benchmarks (some minutes; BENCH="-k vmas" selects some)
	@$(BIN)/python -m pytest tests/benchmarks -q -p no:xdist -o python_files='bench_*.py' $(BENCH)

guard: $(INSTALLED)  ## check that nothing has become slower (a few seconds)
	@$(BIN)/python tests/benchmarks/guard.py

lint: $(INSTALLED)  ## check style, layout and the direction of imports
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@PYTHONPATH=.typing $(BIN)/lint-imports
	@$(BIN)/oxlint trainers/replay/web

typecheck: $(INSTALLED)  ## check the types
	@$(BIN)/basedpyright --pythonpath $(BIN)/python

docs: $(INSTALLED) docs/replay.html  ## build the documentation site in build/docs; warnings are errors (about 2 minutes)
	@OMP_NUM_THREADS=1 $(BIN)/sphinx-build -q -W -E -b html docs build/docs
	@echo "build/docs/index.html"

tables: $(INSTALLED)  ## write the tables of the pages from docs/data
	@$(BIN)/python docs/experiments/tables.py

docs/replay.html: | $(INSTALLED)
	@$(BIN)/emberlink render pretrained:study_front/maps pretrained:study_front/none --fire front:14 --output $@

install: $(INSTALLED)  ## only create .venv

# The marker file identifies an interrupted installation, which is then removed.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "emberlink needs Python 3.11 or later as '$(PYTHON)'; choose one with: make PYTHON=python3.12" >&2; exit 1; }
	@if [ -e $(UNFINISHED) ]; then rm -rf $(VENV); fi
	@mkdir -p $(VENV) && touch $(UNFINISHED)
	@echo "setting up $(VENV) (once; a few minutes)" >&2
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) setuptools
	@$(PIP) --no-build-isolation -e '.[dev]'
	@mv $(UNFINISHED) $(INSTALLED) && touch $(INSTALLED)

clean:  ## remove .venv and generated files, but not runs/
	@rm -rf $(VENV) build dist docs/replay.html *.egg-info .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
