# `make demo` and `make test` need only Python 3.11+, python3-venv and make; they build .venv
# themselves from requirements.lock.  `make help` lists the targets.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
SEED   ?= 1
MINUTES ?= 30
HOURS ?= 300
KILLS ?= 100
DATA ?= recordings
REV ?= HEAD
# Of `make same`: AGAINST another revision, a TOLERANCE, ONLY some recordings, fields to IGNORE.
SAME_OPTIONS = $(if $(AGAINST),--against "$(AGAINST)") $(if $(TOLERANCE),--tolerance $(TOLERANCE)) \
	$(if $(ONLY),--only "$(ONLY)") $(if $(IGNORE),--ignore "$(IGNORE)")
PICO_PATH = $(if $(PICO),PKG_CONFIG_PATH="$(abspath $(PICO))/lib/pkgconfig")
# Two cores are shared, file by file, in the order of their names: by the number of their tests, the
# longest would be among the last.  Tests that start processes come by themselves: what they wait
# for is not delayed by arithmetic, and two of them leave a core idle less often than one.
TOGETHER := -n 2 --dist loadfile --no-loadscope-reorder

# A pipe must fail where pip fails.  What takes time is printed: packages as they come, not what
# each asks for.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
PIP = $(BIN)/python -m pip --disable-pip-version-check install --progress-bar off
PROGRESS = sed -unE 's/^(Collecting|Downloading|Installing|Building) /  &/p'

.DEFAULT_GOAL := help
.PHONY: help env demo test test-all uncompiled check bench scenarios baseline soak fuzz kills links unseen lock wheel clean golden golden-constants same same-faults pico prior strangers second hours honest

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

env: $(STAMP)  ## the virtual environment, from the lock file

$(STAMP): requirements.lock pyproject.toml
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "found no $(PYTHON); expected Python 3.11 or newer;" \
	       "run: apt install python3 python3-venv, or: make PYTHON=/path/to/python3.11"; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "found $$("$(PYTHON)" --version 2>&1); expected Python 3.11 or newer;" \
	       "run: make PYTHON=/path/to/python3.11"; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "found $(PYTHON) without ensurepip; expected the Debian package python3-venv;" \
	       "run: apt install python3-venv"; exit 1; }
	@echo "making $(VENV): $$(grep -cE '^[a-z].*==' requirements.lock) packages," \
	      "some 360 MB to download and 1.4 GB on disk; half a minute and more"
	@"$(PYTHON)" -m venv --clear $(VENV)
	@$(PIP) --require-hashes --requirement requirements.lock | $(PROGRESS)
	@$(PIP) --no-deps --no-build-isolation --editable . | $(PROGRESS)
	@touch $@
	@echo "$(VENV) is ready"

demo: env  ## service and simulator as two processes, a drift, a report in out/demo
	$(BIN)/python -m adaptive_contact demo --out out/demo

test: env  ## unit and property tests on two cores, then end-to-end tests, two at a time
	$(BIN)/python -m pytest $(TOGETHER) --ignore tests/studies -m "not slow and not e2e"
	$(BIN)/python -m pytest $(TOGETHER) -m "not slow and e2e"

test-all: env  ## the same with those of the studies and the slow ones: chains in real time, a million rows
	$(BIN)/python -m pytest $(TOGETHER) -m "not e2e"
	$(BIN)/python -m pytest $(TOGETHER) -m e2e

uncompiled: env  ## the unit tests of detection, learning and fits as plain Python
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(TOGETHER) -m "not slow and not e2e" --timeout 1800 \
	  tests/detect tests/learner tests/model tests/fit tests/robot

check: env  ## ruff, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

same: env  ## revision REV against the working tree on golden recordings, bit by bit (or TOLERANCE=1e-9)
	PYTHONPATH=tests $(BIN)/python -m same --rev "$(REV)" $(SAME_OPTIONS)

prior: env  ## what is known of any leg, from drawn legs, as it ships
	$(BIN)/python -m adaptive_contact_studies.family learn models/adaptive_contact_models/family.json

strangers: env  ## legs without a baseline: swings to the first touch, touches found, false alarms
	$(BIN)/python -m adaptive_contact_studies.family try out/strangers

second: env  ## robots of another physics engine, against an ideal observer of the free path (hours, resumable)
	$(BIN)/python -m adaptive_contact_studies.second out/second

hours: env  ## an hour of one gait on five robots, eight hours of changes on two (two hours, resumable)
	$(BIN)/python -m adaptive_contact_studies.hours out/hours

honest: env  ## HOURS of honest legs of all kinds: at most one in 100 leg-hours is doubted (hours, resumable)
	PYTHONPATH=tests $(BIN)/python -m field.honest out/honest --hours $(HOURS)

unseen: env  ## fits of a real arm, recorded in DATA, on motions and moments that they have not seen
	PYTHONPATH=tests $(BIN)/python tests/fit/bench_unseen.py "$(DATA)" $(UNSEEN_OPTIONS)

links: env  ## 1 to 64 links that are cut or hang, up to 130 viewers that stop reading: events within 0.75 s
	LINKS=1,4,20,64 VIEWERS=10,130 LONGEST_S=0.75 $(BIN)/python -m pytest -s -p no:cacheprovider \
	  tests/service/test_hung_links.py

golden: env  ## what golden recordings are to give, made again: in a commit of its own, with scores before and after
	PYTHONPATH=tests $(BIN)/python -m same --golden $(ONLY)

golden-constants: env  ## 30 constants of detection and learning, doubled and halved: do golden recordings notice? (an hour)
	PYTHONPATH=tests $(BIN)/python -m same.mutants constants seed=$(SEED)

same-faults: env  ## faults of one line that golden recordings must notice, planted one after another
	PYTHONPATH=tests $(BIN)/python -m same.mutants faults

bench: env  ## the design's figures and speeds, in out/bench (half an hour or so)
	$(BIN)/python -m adaptive_contact bench --out out/bench
	PYTHONPATH=tests $(BIN)/python tests/service/bench_echo.py --assert

scenarios: env  ## every drift through every learner; docs/adaptation.md (one to three hours, resumable)
	$(BIN)/python -m pytest $(TOGETHER) tests/studies
	$(BIN)/python -m adaptive_contact scenarios run --all --out out/scenarios
	$(BIN)/python -m adaptive_contact scenarios report --out out/scenarios --docs docs

baseline: env  ## learn the shipped baseline again
	$(BIN)/python -m adaptive_contact sim baseline --force --out models/adaptive_contact_models/hexapod/baseline.json

soak: env  ## MINUTES of walking with drifts, refits, two router kills, one service kill
	PYTHONPATH=tests $(BIN)/python -m soak --minutes $(MINUTES) --seed $(SEED) --out out/soak

fuzz: env  ## ten million broken payloads through the codec and the sample checks
	$(BIN)/python tests/service/fuzz.py 10000000 $(SEED)

# The tests skip without these; here their lack is an error.
pico: env  ## examples/contacts.c compiled and run; needs cc, pkg-config, zenoh-pico 1.x (PICO=its install prefix)
	@{ command -v cc && command -v pkg-config; } >/dev/null || { \
	  echo "found no cc or no pkg-config; run: apt install gcc pkg-config"; exit 1; }
	@$(PICO_PATH) pkg-config --exists zenohpico || { \
	  echo "pkg-config knows no zenohpico; build and install zenoh-pico 1.x with cmake, then run:" \
	       "make pico PICO=/its/install/prefix"; exit 1; }
	$(PICO_PATH) $(BIN)/python -m pytest tests/bridge/test_examples.py -k "in_c"

wheel: env  ## the wheel, in dist
	$(BIN)/python -m build --wheel --no-isolation

kills: env  ## KILLS kill -9s of a saver and of the whole service, at random instants
	KILLS=$(KILLS) $(BIN)/python -m pytest tests/state/test_kill.py

lock: env  ## resolve requirements.lock again (needs uv)
	uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-header --quiet -o requirements.lock

clean:  ## what make made
	rm -rf $(VENV) out dist build
