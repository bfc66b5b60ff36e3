# Two commands are enough on a machine with Python 3.11+ and make:
#   make demo   plan and score a packaged scene, write demo/
#   make test   run the fast tests
# Another interpreter: make test PYTHON=/path/to/python3.12 (used when .venv is created).

PYTHON ?= python3
# Test processes; one needs about 1 GB of memory.
WORKERS ?= 2
PYTEST_ARGS ?=
DEMO_ARGS ?=

PY := .venv/bin/python
INSTALLED := .venv/.installed

.PHONY: demo test test-all lint types wheel-test clean

demo: $(INSTALLED)
	@.venv/bin/spdm demo --out demo $(DEMO_ARGS)

test: $(INSTALLED)
	@$(PY) -m pytest -m "not slow" -n $(WORKERS) $(PYTEST_ARGS)

test-all: $(INSTALLED)
	@$(PY) -m pytest -n $(WORKERS) $(PYTEST_ARGS)

lint: $(INSTALLED)
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

types: $(INSTALLED)
	@$(PY) -m pyright

# Builds the wheel and runs the fast tests against it, away from the checkout.
wheel-test: $(INSTALLED)
	@bash .ci/run wheel

clean:
	rm -rf .venv build dist demo out .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A half-made environment (interrupted, or its interpreter gone) is replaced.
$(INSTALLED): pyproject.toml
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "$(PYTHON) not found; install Python 3.11 or newer, or name one: make PYTHON=/path/to/python" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "$(PYTHON) is `"$(PYTHON)" -V 2>&1`, this project needs 3.11 or newer: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PY) -m pip --version >/dev/null 2>&1 || "$(PYTHON)" -m venv --clear .venv || { \
	  echo "$(PYTHON) cannot create .venv; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@echo "Installing the project into .venv (once, a few minutes) ..."
	@$(PY) -m pip install -qq --no-compile --disable-pip-version-check -e ".[data,plot,cluster,dev]"
	@touch $(INSTALLED)
