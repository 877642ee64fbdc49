# What a user and the CI call. `make help` lists it; everything lands in .venv and out.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/sh

# The interpreter that .venv is made with, 3.11 to 3.13: make PYTHON=python3.12 setup
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
# A second environment, with ROS 2's own rclpy: see ros_ws/wheels.
ROS_VENV := .venv-ros
ROS_PY := $(ROS_VENV)/bin/python
APT := on Debian 12 and Ubuntu 24.04: sudo apt install

# All installs take their versions from the lock file. A stamp in .venv says that a set is in place.
LOCKED := pyproject.toml setup.py requirements.lock
BUILD_INTERFACES := ros_ws/wheels/build_interfaces.py
INTERFACES := $(BUILD_INTERFACES) $(wildcard src/quadvel_msgs/*/* ros_ws/wheels/*/*/*)
INSTALL = -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable

.PHONY: help setup ros demo close-the-loop paper faults test ros-tests test-ros lint format bench lock clean

help:  ## say what there is
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile

setup: $(VENV)/.run  ## create .venv with what running needs (no torch) and the `quadvel` script

demo: setup  ## walk a simulated robot through the nodes; results in out/demo
	$(VENV)/bin/quadvel demo --out out/demo

close-the-loop: setup  ## identify three plants that the model does not know; results in out/twin
	$(VENV)/bin/quadvel twin --out out/twin

paper: setup  ## measure what the paper's figures show; goes on where it was stopped; results in docs/results/paper
	$(VENV)/bin/quadvel paper --out docs/results/paper

ros: $(ROS_VENV)/.run  ## create .venv-ros, where all runs on ROS 2's own rclpy, without a ROS 2 installation

test: $(VENV)/.test  ## install what testing needs (torch too) and run the tests
	$(PY) -m pytest -n 2 --dist loadfile

ros-tests: $(ROS_VENV)/.test

test-ros: $(ROS_VENV)/.test  ## run the tests of the nodes on ROS 2's own rclpy, and beside embedded nodes
	$(ROS_PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder @tests/on_rclpy.txt

lint: $(VENV)/.lint  ## ruff, codespell and mypy
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/codespell
	$(VENV)/bin/mypy

format: $(VENV)/.lint  ## let ruff repair what it can
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

faults: setup  ## let things go wrong in a simulated robot and measure what it does; results in out/faults
	$(VENV)/bin/quadvel faults --out out/faults
	$(VENV)/bin/python -m quadvel_bringup.topic_faults

bench: setup  ## measure this machine; results in out/bench.json
	$(VENV)/bin/quadvel bench --out out/bench.json

lock: $(PY)  ## write requirements.lock anew from the bounds in pyproject.toml
	$(PY) -m pip install --quiet --disable-pip-version-check uv
	$(PY) -m uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 --upgrade \
	    --no-annotate --no-emit-index-url --custom-compile-command "make lock" --output-file requirements.lock

clean:  ## remove both environments, out and caches
	rm -rf $(VENV) $(ROS_VENV) out build .mypy_cache .pytest_cache .ruff_cache *.egg-info

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
	$(PY) $(INSTALL) '.[video,view]'
	@touch $@

$(VENV)/.lint: $(VENV)/.run
	$(PY) $(INSTALL) '.[video,view,lint]'
	@touch $@

$(VENV)/.test: $(VENV)/.run
	$(PY) $(INSTALL) '.[video,view,formats,test,train]'
	@touch $@

# The wheels are for x86-64 alone, and our interfaces are compiled: looked at before anything is installed.
$(ROS_PY): $(PY) $(BUILD_INTERFACES)
	@$(PY) $(BUILD_INTERFACES) --check
	$(PY) -m venv $(ROS_VENV)

$(ROS_VENV)/.run: $(ROS_PY) $(LOCKED) $(INTERFACES)
	@echo "Installing ROS 2's rclpy and what quadvel needs into $(ROS_VENV) (a few minutes the first time) ..."
	$(ROS_PY) $(INSTALL) '.[video,view,ros]'
	$(ROS_PY) $(BUILD_INTERFACES)
	@touch $@

$(ROS_VENV)/.test: $(ROS_VENV)/.run
	$(ROS_PY) $(INSTALL) '.[video,view,formats,ros,test]'
	@touch $@
