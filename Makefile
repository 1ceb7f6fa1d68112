# make demo   the main job on a simulated rig          make test   every test that takes a second or so; make test-slow the others
# make check  all that CI checks                        make bench  speed against the limits
# make real   the table of docs/real-data.md            make rigs   the tables of docs/choose.md on forward-gp
# make methods   all methods side by side, the first table of docs/choose.md
# make odd       300 rigs of all kinds: how many are right, refused, silently wrong
# make active   the tables and the figure of docs/active.md
# make paper  the paper's experiments on five rigs, docs/reproduce.md; goes on from what benchmarks/results keeps
# make clean  start over
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PAPER_CELLS := benchmarks/results/paper-cells.tar.xz
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-slow check lint bench real rigs methods odd active paper clean

demo: $(VENV)/.demo
	$(BIN)/implicam demo

# A process for each core, so one thread each; a file in one process, because its tests share rigs and fits. Bytecode
# is kept, whatever the environment says: commands in processes of their own would compile everything again.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --durations 10 --durations-min 5

test: $(VENV)/.dev
	$(PYTEST) --dist loadfile -m "not slow"

test-slow: $(VENV)/.dev
	$(PYTEST) --dist worksteal -m slow

check: lint test

lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

bench: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python benchmarks/bench.py

odd: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/odd_rigs.py -o benchmarks/results/odd_rigs.md

rigs: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/forward.py --rigs 16

real: $(VENV)/.dev
	$(BIN)/python benchmarks/real_data.py ../shared/real

methods: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/methods.py ../shared/real

active: $(VENV)/.dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/active.py

paper: $(VENV)/.dev
	test -d implicam-paper/cells || { mkdir -p implicam-paper && tar -xJf $(PAPER_CELLS) -C implicam-paper; }
	$(BIN)/implicam paper all
	$(BIN)/python docs/make_reproduce.py implicam-paper

clean:
	rm -rf $(VENV) implicam-demo implicam-paper build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

# One environment; each stamp says what has been put into it.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "implicam needs Python 3.11 or newer; found $$($(PYTHON) -V). Try: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "Python has no venv module here. On Debian or Ubuntu: apt install python3-venv"; rm -rf $(VENV); exit 1; }

KERNEL := setup.py src/implicam/tabulated/kernel.c src/implicam/tabulated/kernel_body.h

$(VENV)/.demo: pyproject.toml constraints.txt $(KERNEL) | $(VENV)/bin/python
	@echo "Setting up (once) ..."
	@$(PIP) --editable ".[app]"
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt $(KERNEL) | $(VENV)/bin/python
	@echo "Setting up (once, a few minutes: the tests compare with PyTorch, scikit-learn and OpenCV) ..."
	@$(PIP) --editable ".[dev]"
	@touch $@
