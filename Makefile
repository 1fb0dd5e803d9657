# ct2lut: `make help` lists what there is to type.
#
# Make decides nothing about freshness: every result is checked by content, in `ct2lut` and in tools/setup.sh.

# What a user types is data. `override NAME := $(value NAME)` stops make from expanding it, an empty MAKEOVERRIDES stops
# make from expanding it again on its way into the environment of a recipe, and recipes read it there, in double quotes.
CASES ?= cases
RESULTS ?= results
PROTOCOL ?= clinical
JOBS ?= 0
DOCKER ?= docker
PROFILE ?= workstation
override ID := $(value ID)
override CASES := $(value CASES)
override RESULTS := $(value RESULTS)
override PROTOCOL := $(value PROTOCOL)
override JOBS := $(value JOBS)
override SET := $(value SET)
override FILE := $(value FILE)
override BASE := $(value BASE)
override DOCKER := $(value DOCKER)
override PROFILE := $(value PROFILE)
override DAYS := $(value DAYS)
export ID CASES RESULTS PROTOCOL JOBS SET FILE BASE DOCKER PROFILE DAYS
MAKEOVERRIDES =

# The interpreter that makes the virtual environment; everything else runs inside it.
PYTHON ?= python3
export PYTHON

SHELL := /bin/sh
BIN := .venv/bin
UV_OPTIONS := --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --quiet
UV_COMPILE := $(BIN)/uv pip compile pyproject.toml --group build $(UV_OPTIONS)

# The words of SET as --set options: split at blanks, never expanded as file name patterns.
OPTIONS = set -f; set --; for pair in $$SET; do set -- "$$@" --set "$$pair"; done; \
	set -- "$$@" --cases "$$CASES" --results "$$RESULTS" --protocol "$$PROTOCOL"
# A demonstration that ends in REVIEW (exit code 11) has worked.
LOOK = || [ $$? -eq 11 ]
# Tests of several files at once, one for each processor; those of one file stay together and in their order.
TOGETHER = -n auto --maxprocesses 4 --dist loadfile
NEED_ID = if [ -z "$$ID" ]; then echo "Which case? Type: make $@ ID=P001" >&2; exit 20; fi

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev setup-cohort demo demo-real check patient plan cohort resume watch tidy status overview report open verify review doctor test lint format faults fuzz test-browser test-exports test-cohort test-cluster test-container image bench scale \
	validate pictures docs lock clean

help:  ## show this list
	@sed -n 's/^\([a-z][a-z-]*\):.*## \(.*\)/  make \1|\2/p' Makefile | \
		while IFS='|' read -r target text; do printf '%-18s %s\n' "$$target" "$$text"; done
	@echo
	@echo '  make patient ID=P001 [CASES=cases] [RESULTS=results] [PROTOCOL=clinical] [JOBS=n] [SET="stage.key=value ..."]'

setup:  ## install everything into .venv (once; checks in a moment that nothing is missing)
	@tools/setup.sh run

setup-dev:
	@tools/setup.sh dev

setup-cohort: setup  ## install the workflow engine for cohorts into .venv-cohort (once)
	@tools/setup.sh cohort

demo: setup  ## make a synthetic CT of a knee (DICOM, no labels), process it, show where the report is
	@[ -d build/demo/cases/demo ] || $(BIN)/ct2lut phantom build/demo/cases --id demo --ct
	@$(BIN)/ct2lut run demo --cases build/demo/cases --results build/demo/results --protocol demo $(LOOK)

demo-real: setup  ## the same with a real knee, segmented from MR (fetches 90 MB the first time)
	@$(BIN)/python -P tools/fetch_real_knee.py build/demo-real/cases/knee
	@$(BIN)/ct2lut run knee --cases build/demo-real/cases --results build/demo-real/results --protocol clinical $(LOOK)

check: setup  ## look at a case before it is processed, in seconds: make check ID=P001
	@$(NEED_ID); $(OPTIONS); $(BIN)/ct2lut check "$$@" -- "$$ID"

patient: setup  ## process one case: make patient ID=P001
	@$(NEED_ID); $(OPTIONS); $(BIN)/ct2lut run "$$@" --jobs "$$JOBS" -- "$$ID"

plan: setup  ## say which stages of a case would run, and why: make plan ID=P001
	@$(NEED_ID); $(OPTIONS); $(BIN)/ct2lut plan "$$@" -- "$$ID"

cohort: setup setup-cohort  ## process every case of a folder or list: make cohort CASES=cases [PROFILE=slurm]
	@$(OPTIONS); [ "$$JOBS" = 0 ] || set -- "$$@" --jobs "$$JOBS"; $(BIN)/ct2lut cohort "$$@" --profile "$$PROFILE"

resume: setup setup-cohort  ## go on with the last cohort of a results folder: make resume [RESULTS=results]
	@$(BIN)/ct2lut resume --results "$$RESULTS"

watch: setup  ## process cases as they arrive: make watch CASES=cases [RESULTS=results]
	@$(OPTIONS); [ "$$JOBS" = 0 ] || set -- "$$@" --jobs "$$JOBS"; $(BIN)/ct2lut watch "$$@"

status: setup  ## how far one case (ID=P001) or every case has got
	@set --; if [ -n "$$ID" ]; then set -- -- "$$ID"; fi; $(BIN)/ct2lut status --results "$$RESULTS" "$$@"

overview: setup  ## one page of all cases, brought up to date: make overview [RESULTS=results]
	@$(BIN)/ct2lut overview --results "$$RESULTS"

report: setup  ## bring the report of a case up to date and say where it is: make report ID=P001
	@$(NEED_ID); $(OPTIONS); $(BIN)/ct2lut report "$$@" --jobs "$$JOBS" -- "$$ID"

open: setup  ## show the report of a case in a browser, or say where it is: make open ID=P001
	@$(NEED_ID); $(BIN)/ct2lut open --results "$$RESULTS" -- "$$ID"

verify: setup  ## compare the results of one case (ID=P001) or of all with their recorded checksums
	@set --; if [ -n "$$ID" ]; then set -- -- "$$ID"; fi; $(BIN)/ct2lut verify --results "$$RESULTS" "$$@"

tidy: setup  ## remove what killed runs left in a results folder: make tidy [RESULTS=results] [DAYS=7]
	@$(BIN)/ct2lut clean --results "$$RESULTS" --older-than-days "$${DAYS:-7}"

review: setup  ## keep the decision that the report page saved: make review ID=P001 FILE=P001_review.json
	@$(NEED_ID); $(BIN)/ct2lut review --results "$$RESULTS" -- "$$ID" "$$FILE"

doctor: setup  ## look whether this machine has what a run needs: make doctor [RESULTS=results]
	@$(BIN)/ct2lut doctor --results "$$RESULTS"

test: setup-dev  ## run the tests
	@$(BIN)/python -P -m pytest $(TOGETHER)

lint: setup-dev  ## check style and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: setup-dev  ## mend what `make lint` can mend by itself
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

faults: setup-dev  ## run the tests of what may be wrong with a case (docs/faults.md)
	@$(BIN)/python -P -m pytest $(TOGETHER) -m fault

fuzz: setup-dev  ## mutate scanner files more than a hundred times as often as the tests do; nothing may break out
	@HOSTILE_MUTATIONS=1000 $(BIN)/python -P -m pytest tests/end_to_end/test_hostile_files.py -k "flipped or spoilt"

test-cohort: setup-dev setup-cohort  ## 200 phantom cases, 20 of them broken, killed three times on the way (an hour, 8 GB)
	@rm -rf build/test-cohort
	@$(BIN)/python -m tests.cohort.real --cases 200 --broken 20 --kills 3 --most-overhead 5 --work build/test-cohort

test-browser: setup-dev  ## try every page in Chromium (skips without one)
	@$(BIN)/python -P -m pytest tests/players -rs

test-exports: setup-dev  ## put the exports before the validators of their worlds (needs npm; OpenSim's wheel is 200 MB)
	@npm install --silent --prefix build/validators gltf-validator
	@command -v dciodvfy >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get -qq update && \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends dicom3tools >/dev/null; } || \
		echo "dciodvfy is missing, DICOM objects are not validated; type: sudo apt-get install dicom3tools" >&2
	@[ -x build/validators/osim/bin/python ] || $(PYTHON) -m venv build/validators/osim
	@build/validators/osim/bin/pip install --quiet opensim
	@CT2LUT_NODE_MODULES=build/validators/node_modules CT2LUT_OPENSIM_PYTHON=build/validators/osim/bin/python \
		$(BIN)/python -P -m pytest tests/exports

test-cluster: setup-dev setup-cohort  ## run cohorts on a SLURM that is started on this machine for it (root; 20 minutes)
	@[ "$$(id -u)" = 0 ] || { echo "the daemons of a cluster need root; type: sudo make test-cluster" >&2; exit 30; }
	@command -v sbatch >/dev/null && [ -x /usr/sbin/slurmctld ] && [ -x /usr/sbin/slurmd ] && [ -x /usr/sbin/munged ] || \
		{ command -v apt-get >/dev/null && apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get install -qq \
		--no-install-recommends slurmctld slurmd slurm-client slurm-wlm-basic-plugins munge >/dev/null; } || \
		{ echo "type: apt-get install slurmctld slurmd slurm-client slurm-wlm-basic-plugins munge" >&2; exit 30; }
	@CT2LUT_TEST_CLUSTER=yes $(BIN)/python -P -m pytest tests/cluster -rs

test-container: setup-dev  ## build the image without Docker and run a patient in it (root; the network, 10 minutes, 5 GB)
	@[ "$$(id -u)" = 0 ] || { echo "building an image without a daemon needs root; type: sudo make test-container" >&2; exit 30; }
	@command -v buildah >/dev/null && command -v podman >/dev/null && command -v runc >/dev/null && \
		command -v debootstrap >/dev/null || { apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get install -qq \
		--no-install-recommends buildah podman runc debootstrap >/dev/null; } || \
		{ echo "type: apt-get install buildah podman runc debootstrap" >&2; exit 30; }
	@CT2LUT_TEST_CONTAINER=yes $(BIN)/python -P -m pytest tests/container -rs

image:  ## build the container image ct2lut: make image [BASE=debian:bookworm-slim@sha256:...] [DOCKER=podman]
	@command -v "$$DOCKER" >/dev/null || { echo "no $$DOCKER on this machine; name another: make image DOCKER=podman" >&2; exit 30; }
	@set --; if [ -n "$$BASE" ]; then set -- --build-arg "BASE=$$BASE"; fi; \
		revision=$$(git describe --always --dirty --abbrev=40 2>/dev/null || echo unknown); \
		BUILDAH_FORMAT=docker "$$DOCKER" build "$$@" --build-arg "REVISION=$$revision" --tag ct2lut .

bench: setup-dev  ## measure speed
	@$(BIN)/python -m tests.bench

scale: setup-dev setup-cohort  ## a cohort of 10,000 stub cases: what engine, batches and overview cost (10 minutes, 5 GB)
	@$(BIN)/python -m tests.scale

validate: setup-dev  ## compare with closed forms, the paper's test objects and published data
	@$(BIN)/python -m tests.validate

pictures: setup-dev  ## draw the pictures of the guides (docs/images) from phantom knees; those of pages need Chromium
	@$(BIN)/python -m tools.pictures build/pictures docs/images

docs: setup-dev  ## write the reference pages in docs/ and the flow in pipeline/README.md from the code
	@$(BIN)/python -m tools.reference docs

lock: setup-dev  ## resolve the versions of every dependency again
	@$(UV_COMPILE) --upgrade --output-file requirements.lock
	@$(UV_COMPILE) --extra dev --constraint requirements.lock --output-file requirements-dev.lock
	@$(BIN)/uv pip compile --group cohort $(UV_OPTIONS) --upgrade --output-file requirements-cohort.lock

clean:  ## remove the virtual environment, caches and demos; never cases or results
	@rm -rf .venv .venv-cohort build .pytest_cache .ruff_cache .mypy_cache ct2lut.egg-info
	@find pipeline tests tools -name __pycache__ -prune -exec rm -rf {} +
