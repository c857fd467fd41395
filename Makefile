# make demo    three robots in a generated world, one report: creates .venv and installs what that needs
# make test    installs what tests need and runs all of them: ruff, mypy, import contracts, pytest
# make swarm-test   shipped scenarios over real zenoh, a worse variant of each that must fail, observers: six minutes
# make check   the same without installing anything
# make docs    the pages as a searchable site: build/site/index.html
# make release-check   builds what would be published, checks its metadata, installs it in a fresh environment, runs flocc demo --small
# make campaign     cores broken on purpose, with the seeds that each took; the back end and others on 300 drawn graphs
#                   (DRAWS=60 for a sweep), at most an hour (LIMIT_S); what a leader holds over eight simulated hours
#                   (MISSION_MINUTES)
# make clean   removes .venv and everything that was generated

SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
UNIT_JOBS ?= 3
DRAWS ?= 300
LIMIT_S ?= 3600
MISSION_MINUTES ?= 480
DEMO_OUT ?= runs/demo
TEST_EXTRAS := $(shell sed -n '/^\[project.optional-dependencies\]/,/^\[/s/^\([a-z0-9]*\) = \[.*/\1/p' pyproject.toml | paste -sd,)

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
DESCRIPTION := pyproject.toml constraints.txt

# Dozens of processes start in a run and in the tests: each compiles all of flocc where Python may not keep what it compiled.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test swarm-test check lint types contracts tests campaign docs install release-check constraints clean
.DEFAULT_GOAL := check

demo: $(VENV)/.demo
	$(BIN)/flocc demo --out $(DEMO_OUT)

test: $(VENV)/.test
	@$(MAKE) --no-print-directory check

# mypy has one core only: it runs beside the tests, whose live swarms go first.
check: lint contracts
	@$(MAKE) --no-print-directory -j 2 types tests

lint:
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types:
	nice -n 19 $(BIN)/mypy

contracts:
	$(BIN)/lint-imports

# Two workers run live swarms that measure nothing in time, which mostly wait; what only computes takes the rest of the
# two cores beside them, at the lowest priority, with a worker more than cores: unit tests wait too, for processes, timers
# and disks. Live swarms that measure get the machine to themselves. What fails of a
# live swarm is tried once more, alone, since the machine itself may stall; all is printed. To find the live ones, only
# the files that name their mark are read: reading all of them takes 20 s of CPU in each of three processes.
LIVE := swarm and not scenarios
LIVE_FILES = $$(grep -rlE "mark\.swarm" tests --include="test_*.py")
tests:
	@mkdir -p build; set -o pipefail; status=0; live=0; export OMP_NUM_THREADS=1; \
	set -m; nice -n 19 $(BIN)/python -m pytest -q -n $(UNIT_JOBS) --dist worksteal -o cache_dir=.pytest_cache/unit -m "not swarm" > build/pytest.txt 2>&1 & unit=$$!; set +m; \
	trap 'kill -- -$$unit 2>/dev/null' EXIT; \
	rm -f build/pytest-swarm-again.txt; \
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m "$(LIVE) and beside" $(LIVE_FILES) | tee build/pytest-beside.txt || live=1; \
	wait $$unit || status=1; trap - EXIT; cat build/pytest.txt; unset OMP_NUM_THREADS; \
	$(BIN)/python -m pytest -q -m "$(LIVE) and not beside" $(LIVE_FILES) | tee build/pytest-swarm.txt || live=1; \
	[ $$live -eq 0 ] || $(BIN)/python -m pytest -q -m "$(LIVE)" --lf --lfnf none $(LIVE_FILES) | tee build/pytest-swarm-again.txt || status=1; \
	echo "pytest:                    $$(tail -n 1 build/pytest.txt)"; \
	echo "live swarms, side by side: $$(tail -n 1 build/pytest-beside.txt)"; \
	echo "live swarms, alone:        $$(tail -n 1 build/pytest-swarm.txt)"; \
	[ ! -e build/pytest-swarm-again.txt ] || echo "second try of what failed: $$(tail -n 1 build/pytest-swarm-again.txt)"; \
	exit $$status

swarm-test: $(VENV)/.test
	$(BIN)/python -m pytest -q -m scenarios

# Every mutant of the core; then the back end on 300 graphs of the family, beside what others do, whose rows stay; then
# eight simulated hours of ten robots, and what their leader holds.
campaign: $(VENV)/.test
	@mkdir -p build
	FLOCC_MUTANTS=all nice -n 19 $(BIN)/python -m pytest -q -s -n0 tests/simulation/test_mutants.py
	OMP_NUM_THREADS=1 nice -n 19 $(BIN)/python -m flocc_lab.graph_family --draws $(DRAWS) --methods "" \
		--rows build/graph_family.jsonl --limit-s $(LIMIT_S) | tee build/graph_family.md
	OMP_NUM_THREADS=1 nice -n 19 $(BIN)/python -m flocc_lab.held --robots 10 --minutes $(MISSION_MINUTES) --held 5000 \
		--area-m 2000 --parts 8 | tee build/held.jsonl

docs: $(VENV)/.test
	$(BIN)/python -m flocc_lab.reference.site_pages build/pages
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "site: $(CURDIR)/build/site/index.html"

install: $(VENV)/.test

release-check: $(VENV)/.test
	$(BIN)/python .ci/release_check.py

constraints: $(VENV)/.test
	$(BIN)/python .ci/constraints.py > constraints.new
	mv constraints.new constraints.txt

# A stamp per set of requirements: a second run installs nothing.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' \
		|| { echo "flocc needs Python 3.11 to 3.14: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
		|| { rm -rf $(VENV); echo "$(PYTHON) -m venv failed; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }

$(VENV)/.demo: $(DESCRIPTION) | $(VENV)/bin/python
	$(PIP) -e '.[mcap]'
	@touch $@

$(VENV)/.test: $(DESCRIPTION) | $(VENV)/bin/python
	$(PIP) -e '.[$(TEST_EXTRAS)]'
	@touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) build dist runs .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find protocol agent launch lab tests -name __pycache__ -prune -exec rm -rf {} +
