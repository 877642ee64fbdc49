# What a user and the CI call. `make help` lists it; everything lands in .venv and out.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/sh

# The interpreter that .venv is made with, 3.11 to 3.13: make PYTHON=python3.12 setup
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
APT := on Debian 12 and Ubuntu 24.04: sudo apt install

# All installs take their versions from the lock file. A stamp in .venv says that a set is in place.
LOCKED := pyproject.toml setup.py requirements.lock
INSTALL = $(PY) -m pip install --quiet --disable-pip-version-check --constraint requirements.lock

.PHONY: help setup demo close-the-loop paper test lint format bench lock clean

help:  ## say what there is
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile

setup: $(VENV)/.run  ## create .venv with what running needs (no torch) and the `quadvel` script

demo: setup  ## walk a simulated robot through the nodes; results in out/demo
	$(VENV)/bin/quadvel demo --out out/demo

close-the-loop: setup  ## identify three plants that the model does not know; results in out/twin
	$(VENV)/bin/quadvel twin --out out/twin

paper: setup  ## measure what the paper's figures show; goes on where it was stopped; results in docs/results/paper
	$(VENV)/bin/quadvel paper --out docs/results/paper

test: $(VENV)/.test  ## install what testing needs (torch too) and run the tests
	$(PY) -m pytest -n 2 --dist loadfile

lint: $(VENV)/.lint  ## ruff and mypy
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy

format: $(VENV)/.lint  ## let ruff repair what it can
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

bench: setup  ## measure this machine; results in out/bench.json
	$(VENV)/bin/quadvel bench --out out/bench.json

lock: $(PY)  ## write requirements.lock anew from the bounds in pyproject.toml
	$(PY) -m pip install --quiet --disable-pip-version-check uv
	$(PY) -m uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 --upgrade \
	    --no-annotate --no-emit-index-url --custom-compile-command "make lock" --output-file requirements.lock

clean:  ## remove .venv, out and caches
	rm -rf $(VENV) out build .mypy_cache .pytest_cache .ruff_cache *.egg-info

$(PY):
	@command -v "$(PYTHON)" >/dev/null || { \
	    echo "quadvel needs Python 3.11 to 3.13 and found no '$(PYTHON)'; $(APT) python3 python3-venv" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || { \
	    echo "quadvel needs Python 3.11 to 3.13, and '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1);" \
	         "name another one: make PYTHON=python3.12 setup" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "'$(PYTHON)' cannot make virtual environments; $(APT) python3-venv" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)

$(VENV)/.run: $(PY) $(LOCKED)
	@echo "Installing what quadvel needs into $(VENV) (a few minutes the first time) ..."
	$(INSTALL) --editable '.[video]'
	@touch $@

$(VENV)/.lint: $(VENV)/.run
	$(INSTALL) --editable '.[video,lint]'
	@touch $@

$(VENV)/.test: $(VENV)/.run
	$(INSTALL) --editable '.[video,test,train]'
	@touch $@
