# Everything from a machine with Python (3.11 or newer) and make: `make demo` and `make test` install what they need into .venv.
# `make PYTHON=python3.12 test` chooses the interpreter, `make test PYTEST_ARGS='-k sector'` passes options on to pytest.

PYTHON ?= python3
PYTEST_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
DEMO_PATTERN := checkerboard:8x6:30mm

# The installed omnilines is the working tree itself (-e). The constraints hold for the build as well: pip 25.3 and later read
# the second variable, earlier ones the first (relative, since pip splits it at blanks).
INSTALL = @echo "Installing $(1) into $(VENV); the first time takes a few minutes."; \
	PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e "$(1)"

.PHONY: help setup demo test test-all lint docs tables audit bench clean
# Two pips must not write into one environment at a time.
.NOTPARALLEL:

help:
	@echo "make demo      install, calibrate a camera from photos it renders, rebuild the lines; ends by naming the report"
	@echo "make test      install and run the tests; CI=1 make test: those that take long, too"
	@echo "make test-all  with all Monte Carlo seeds, and every benchmark once"
	@echo "make setup     install the omnilines command      make lint       style, types and the import contract"
	@echo "make docs      build the site into site/         make tables     write the tables and notebooks of docs/ anew"
	@echo "make audit     known weaknesses of the packages that constraints.txt pins (asks pypi.org)"
	@echo "make bench     speed and accuracy tables          make clean      remove what the targets made"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "omnilines needs Python 3.11 or newer, found $$($(PYTHON) --version 2>&1); name one: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# One stamp for each set of extras, newer than what decides the installation; a second run finds it and installs nothing.
$(VENV)/.installed-run: pyproject.toml constraints.txt | $(BIN)/python
	$(call INSTALL,.)
	@touch $@

$(VENV)/.installed-%: pyproject.toml constraints.txt | $(VENV)/.installed-run
	$(call INSTALL,.[$*])
	@touch $@

setup: $(VENV)/.installed-run

demo: setup
	@rm -rf demo
	$(BIN)/omnilines render targets --model opencv-fisheye --fov-deg 190 --views 12 --size 1024x768 --pattern $(DEMO_PATTERN) --out demo/photos
	$(BIN)/omnilines calibrate demo/photos --pattern $(DEMO_PATTERN) --model opencv-fisheye --out demo/calibration
	$(BIN)/omnilines experiment board --data demo/photos --pattern $(DEMO_PATTERN) --model opencv-fisheye --out demo/lines
	@echo
	@echo "The calibration is in demo/calibration/report.html, the lines are in demo/lines/report.html."
	@echo "Open $(CURDIR)/demo/lines/report.html"

# What takes long is left to CI (`.ci/run` sets the variable). Two workers would each compile the same functions.
test: $(VENV)/.installed-test
	@$(BIN)/python -m omnilines.compiling
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not full$(if $(CI),, and not slow)" $(PYTEST_ARGS)

test-all: $(VENV)/.installed-test
	@$(BIN)/python -m omnilines.compiling
	$(BIN)/python -m pytest -n 2 --dist worksteal $(PYTEST_ARGS)

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# A warning, such as a link that leads nowhere, is an error.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "Open $(CURDIR)/site/index.html"

# What the program itself decides: commands, models, formats, options; notebooks from the walks.
tables: setup
	$(BIN)/python docs/scripts/tables.py
	$(BIN)/python docs/scripts/walks.py --notebooks
	$(BIN)/python -m omnilines.pages.options docs/options.md

# Needs the network, hence no part of lint. Its own packages are no concern of ours either.
audit:
	$(PYTHON) -m venv .venv-audit
	.venv-audit/bin/python -m pip install --quiet --disable-pip-version-check "pip-audit>=2.7"
	.venv-audit/bin/pip-audit --strict --no-deps --disable-pip --progress-spinner off -r constraints.txt

# Other implementations to compare with have an environment of their own: what they depend on is no concern of ours.
.venv-peers/.installed: tests/bench/peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --disable-pip-version-check -r tests/bench/peers.txt
	@touch $@

# Without the tests' conftest, which enforces array shapes at every call.
bench: $(VENV)/.installed-test .venv-peers/.installed
	$(BIN)/python -m pytest tests/bench --noconftest -p no:cacheprovider -q -s -o pythonpath="tests/bench tests" \
		-o python_files="bench_*.py" -o python_functions="bench_*" $(PYTEST_ARGS)

clean:
	rm -rf $(VENV) .venv-peers .venv-audit build dist demo site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
