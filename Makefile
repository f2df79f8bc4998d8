# `make demo` and `make test` are all that a newcomer needs. Both make the environment first.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
SEED   ?= 0
SEEDS  ?= 0-9
CELLS  ?= cr ir
KILLS  ?= 30
JOBS   ?= 2

# One BLAS thread: results are the same to the last digit on one machine, and the solver child
# does not fight the camera for two cores.
export OPENBLAS_NUM_THREADS = 1
export OMP_NUM_THREADS = 1

.PHONY: help install demo test format lint types imports unit clean \
	format-fix soak-tests soak-kill soak-faults soak-demo soak-core bench-accuracy bench-render bench-solvers

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 16

install: $(VENV)/.installed ## Make the virtual environment

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: install ## Calibrate the simulated cells CELLS, unattended, and prove it
	@for cell in $(CELLS); do $(BIN)/cellctl demo --cell $$cell --seed $(SEED) || exit; done

test: install format lint types imports unit ## Everything that CI checks

format: install
	$(BIN)/ruff format --check

lint: install
	$(BIN)/ruff check

types: install
	$(BIN)/mypy

imports: install
	$(BIN)/lint-imports

unit: install
	$(BIN)/pytest -n $(JOBS) --dist loadfile

soak-tests: install ## The tests that `make test` leaves out because they take long
	CELLCTL_SOAK=$(KILLS) $(BIN)/pytest -n $(JOBS) --dist loadfile

soak-kill: install ## SIGKILL the daemon at KILLS random instants, resume, compare
	$(BIN)/python -m tests.soak.kill --kills $(KILLS) --seed $(SEED)

soak-faults: install ## A whole run for each fault of pen and paper: is it named?
	$(BIN)/python -m tests.soak.faults --cell cr --seed $(SEED)

soak-demo: install ## The demo of CELLS on SEEDS: verdicts, true errors, rows beside the model's
	for cell in $(CELLS); do $(BIN)/python -m benchmarks.stages --cell $$cell --seeds $(SEEDS) || exit; done

soak-core: install ## Kill the engine with a toy procedure KILLS times
	CELLCTL_SOAK=$(KILLS) $(BIN)/pytest tests/core/test_crash.py

bench-accuracy: install ## True millimetres in the standard worlds, the published pipeline beside ours
	$(BIN)/python -m benchmarks.accuracy --jobs $(JOBS)

bench-render: install ## Milliseconds a rendered picture
	$(BIN)/python -m benchmarks.render

bench-solvers: install ## The adjustments against OpenCV and SciPy
	$(BIN)/python -m benchmarks.solvers

format-fix: install ## Let ruff format
	$(BIN)/ruff format

clean: ## Remove the environment and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
