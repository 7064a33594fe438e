# Every target installs what it needs into .venv first; nothing outside this folder is touched.
#   make demo       plan and drive a mixed terrain with the shipped toy specialists; writes demo/
#   make test       every test          make test-fast  those that take under a minute together
#   make check      lint, types, imports
#   make clean      remove what the targets made (.venv too)
# PYTHON=/path/to/python chooses the interpreter for .venv (3.11 or newer).

VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.installed-base
ALL := $(VENV)/.installed-all

.PHONY: demo test test-fast check clean
.DELETE_ON_ERROR:

demo: $(BASE)
	$(BIN)/fgtutor demo

test: $(ALL)
	$(BIN)/python -m pytest

test-fast: $(ALL)
	$(BIN)/python -m pytest -m "not slow"

check: $(ALL)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	$(BIN)/pyright

clean:
	rm -rf $(VENV) demo build *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A version manager may put a python3.13 on the path that does not start: each candidate is tried.
$(VENV)/bin/python:
	@set -e; found=; \
	for candidate in $(or $(PYTHON),python3.13 python3.12 python3.11 python3 python); do \
	  if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	    found=$$candidate; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "fgtutor needs Python 3.11 or newer, and none was found on the PATH." >&2; \
	  echo "Install one, or name it: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)" >&2; exit 1; fi; \
	if ! $$found -c 'import ensurepip, venv' >/dev/null 2>&1; then \
	  echo "$$found has no venv module, which fgtutor needs to install beside your system." >&2; \
	  echo "On Debian or Ubuntu: apt install python3-venv. Or: make PYTHON=/path/to/another" >&2; \
	  exit 1; fi; \
	echo "Creating $(VENV) with $$found"; \
	rm -rf $(VENV); $$found -m venv $(VENV)

$(BASE): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(ALL): pyproject.toml constraints.txt $(BASE)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[lab,dev]'
	@touch $@
