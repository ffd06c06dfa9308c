# `make demo` and `make test` start from nothing: on Debian 12 with git, make and Python 3.11 they install what is missing.
# What is done is remembered by stamps inside .venv, so a second call starts at once; `make clean` forgets.

PYTHON ?= python3
SCENES ?=
TESTS ?=
MODEL ?=
LABELS ?=
CARD ?=

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/stamps
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
DEBIAN := g++ python3-venv python3-dev libopenvdb-dev libboost-iostreams-dev libllvm19
# Runs a command and says how long it took.
timed = started=$$(date +%s); $(1) && echo "  $$(( $$(date +%s) - started )) s"

# The editable install knows the modules by name: one more or less asks for it anew (seconds; nothing is compiled).
LAYOUT := $(STAMPS)/layout-$(shell find deepclouds training/deepclouds_training runtime/deepclouds_runtime -name '*.py' | LC_ALL=C sort | cksum | cut -d' ' -f1)
NATIVE := CMakeLists.txt $(wildcard deepclouds/volume/native/*)

.DEFAULT_GOAL := help
.NOTPARALLEL:
.SILENT:
.DELETE_ON_ERROR:
.PHONY: help demo demo-reference test check accuracy card bench bench-labels labels train-model setup setup-test setup-bench setup-train clean

help:
	echo "make demo            render the demo cloud"
	echo "make demo-reference  the same, beside a path-traced reference"
	echo "make test            all tests (TESTS='tests/unit -k vdb' for some)"
	echo "make check           style and types"
	echo "make bench           run time against error (SCENES=folder for other scenes)"
	echo "make accuracy        how far images, furnace, slabs, held-out labels and hard cases are from the truth"
	echo "make card            the page about the released models, from their metadata and docs/figures"
	echo "make bench-labels    cost of training labels beside Mitsuba's volpath"
	echo "make labels          the labels to train on and those to judge by; run again after an interruption, it goes on"
	echo "make train-model     labels, training, export and calibration of both models; run again after an interruption, it goes on"
	echo "make setup           the installation alone; setup-test, setup-bench, setup-train add their packages"
	echo "make clean           remove .venv and build"

demo: setup
	$(BIN)/python -m deepclouds_runtime.demo

demo-reference: setup
	$(BIN)/python -m deepclouds_runtime.demo --reference

test: setup-test
	$(BIN)/python -m pytest -q $(TESTS)

check: setup-test
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy

bench: setup-bench
	$(BIN)/python -m benchmarks.bench $(if $(SCENES),--scenes $(SCENES))

# Makes a data set as one job shared by as many processes as there are processors, each of which does its part of the shards.
# Jobs in the background do not hear Ctrl-C: they are ended with the recipe, and so are the others where one fails.
generate = parts=$$(nproc); running=""; trap 'kill $$running 2>/dev/null; wait; exit 130' INT TERM; \
  for part in $$(seq 0 $$((parts - 1))); do \
    $(BIN)/deepclouds generate $(1) --shard $$part/$$parts & running="$$running $$!"; \
  done; \
  for process in $$running; do wait $$process || { kill $$running 2>/dev/null; wait; exit 1; }; done; trap - INT TERM

# Every step goes on where it was interrupted, and is passed over once it is done.
train-model: setup-train
	$(call generate,configs/labels.toml -o work/labels)
	$(call generate,configs/valid_halves_labels.toml -o work/valid_halves)
	if [ -e work/accurate_run/config.json ]; then how=--resume; else how=configs/accurate.toml; fi; \
	  $(BIN)/deepclouds train $$how -o work/accurate_run
	$(BIN)/deepclouds export work/accurate_run -o work/accurate.onnx
	$(BIN)/deepclouds export work/accurate_run --companion -o work/fast.onnx
	for model in accurate fast; do \
	  $(BIN)/deepclouds calibrate work/$$model.onnx --data work/labels --labels work/valid_halves || exit; \
	done

# The training labels and the held-out ones that a model is judged by; a tenth of the latter once more by Mitsuba's volpath.
labels: setup-train
	$(call generate,configs/labels.toml -o work/labels)
	for set in converged halves; do \
	  $(call generate,configs/valid_$${set}_labels.toml -o work/valid_$$set); \
	  $(call generate,configs/valid_$${set}_labels.toml --tracer mitsuba -o work/valid_$${set}_volpath); \
	done

# LABELS names folders of held-out labels, as `make labels` makes them.
accuracy: setup-test
	$(BIN)/python -m benchmarks.accuracy $(if $(SCENES),--scenes $(SCENES)) $(if $(MODEL),--model $(MODEL)) $(if $(CARD),--card) $(foreach folder,$(LABELS),--labels $(folder))

# Of the released models, with the figures that `make accuracy MODEL=NAME CARD=1` keeps in docs/figures.
card: setup
	$(BIN)/deepclouds card accurate fast --figures docs/figures -o docs/model_card.md

bench-labels: setup-test
	$(BIN)/python -m benchmarks.labels

setup: $(STAMPS)/installed
setup-test: $(STAMPS)/extra-test
setup-bench: $(STAMPS)/extra-bench
setup-train: $(STAMPS)/extra-train

# Outside .venv nothing may be assumed: the Debian packages come first, since python3-venv makes .venv.
$(STAMPS)/python:
	missing=""; \
	if command -v dpkg-query >/dev/null; then \
	  for package in $(DEBIAN); do \
	    dpkg-query -W -f '$${Status}' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	  done; \
	else \
	  echo "This is not Debian: OpenVDB 10, Boost iostreams, a C++17 compiler, Python's headers and LLVM must be installed already."; \
	fi; \
	if [ -n "$$missing" ]; then \
	  line="apt-get update && apt-get install -y$$missing"; \
	  if [ "$$(id -u)" = 0 ]; then as=""; \
	  elif command -v sudo >/dev/null && { [ -t 0 ] || sudo -n true 2>/dev/null; }; then as="sudo"; \
	  else echo "Debian packages are missing. Run this as root, then try again:"; echo "  $$line"; exit 1; fi; \
	  echo "Installing Debian packages:$$missing"; \
	  log=$$(mktemp); \
	  if ! { $$as apt-get -q -o DPkg::Lock::Timeout=300 update && \
	         $$as env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=300 install $$missing; } >$$log 2>&1; then \
	    tail -n 15 $$log; rm -f $$log; echo "That failed. Run this as root, then try again:"; echo "  $$line"; exit 1; \
	  fi; \
	  rm -f $$log; \
	fi
	command -v $(PYTHON) >/dev/null && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "$(PYTHON) is not Python 3.11 or newer; name one: make PYTHON=/path/to/python3.11"; exit 1; }
	echo "Creating $(VENV)"
	$(call timed,$(PYTHON) -m venv $(VENV))
	mkdir -p $(STAMPS)
	touch $@

$(STAMPS)/build-tools: constraints.txt | $(STAMPS)/python
	echo "Installing the build tools"
	$(call timed,$(PIP) install -c constraints.txt scikit-build-core nanobind cmake ninja)
	touch $@

$(LAYOUT): | $(STAMPS)/python
	rm -f $(STAMPS)/layout-*
	touch $@

# Built without isolation, with the pinned tools: what is compiled once stays in build/ and is not compiled again.
$(STAMPS)/installed: pyproject.toml constraints.txt LICENSE $(NATIVE) $(STAMPS)/build-tools $(LAYOUT)
	echo "Installing deepclouds, its Python packages and its OpenVDB module (minutes the first time)"
	$(call timed,$(PIP) install -c constraints.txt --no-build-isolation -e .)
	touch $@

# The name finds the editable install, so only the extra's packages are added.
$(STAMPS)/extra-%: $(STAMPS)/installed
	echo "Installing the Python packages for '$*'"
	$(call timed,$(PIP) install -c constraints.txt "deepclouds[$*]")
	touch $@

clean:
	rm -rf $(VENV) build
