# Commands for users and the CI; `make help` lists them. They write only to .venv and out.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/sh

# Interpreter for .venv, 3.11 to 3.13: make PYTHON=python3.12 setup
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
# A second environment, with ROS 2's own rclpy: see ros_ws/wheels.
ROS_VENV := .venv-ros
ROS_PY := $(ROS_VENV)/bin/python
# What draws the diagrams of the site. The site serves it itself, so that no page loads code of another host.
MERMAID := out/mermaid
MERMAID_VERSION := 11.12.1
APT := on Debian 12 and Ubuntu 24.04: sudo apt install

# The lock file sets the versions of all installs. A stamp file in .venv marks an installed set.
LOCKED := pyproject.toml setup.py requirements.lock
BUILD_INTERFACES := ros_ws/wheels/build_interfaces.py
INTERFACES := $(BUILD_INTERFACES) $(wildcard src/quadvel_msgs/*/* ros_ws/wheels/*/*/*)
INSTALL = -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable

# Sections of `make paper` that do not ask for the AlienGo's own actuator model or the paper's curves.
GO2_SECTIONS := gait tracking sustained steps energy robustness slopes stance

.PHONY: help setup ros demo close-the-loop paper faults test tutorials ros-tests test-ros lint format docs pictures bench lock clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile

setup: $(VENV)/.run  ## create .venv with the `quadvel` command and its dependencies (no torch)

demo: setup  ## run the demo walk of a simulated robot; results in out/demo
	$(VENV)/bin/quadvel demo --out out/demo

close-the-loop: setup  ## test the identification on three plants with unknown effects; results in out/twin
	$(VENV)/bin/quadvel twin --out out/twin

paper: setup  ## measure the paper's figures with both robots; resumes after a stop; results in docs/results
	$(VENV)/bin/quadvel paper --out docs/results/paper
	$(VENV)/bin/quadvel paper --robot go2 --out docs/results/paper_go2 $(GO2_SECTIONS:%=--only %)

ros: $(ROS_VENV)/.run  ## create .venv-ros with ROS 2's own rclpy; needs no ROS 2 installation

test: $(VENV)/.test  ## install the test dependencies (torch too) and run the tests
	$(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder

tutorials: $(VENV)/.test  ## run every cell of the site's pages
	$(PY) -m pytest -n 2 -m tutorial tests/end_to_end/test_tutorials.py

ros-tests: $(ROS_VENV)/.test

test-ros: $(ROS_VENV)/.test  ## run the node tests on ROS 2's own rclpy, also together with embedded nodes
	$(ROS_PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder @tests/on_rclpy.txt

lint: $(VENV)/.lint  ## check code and documents with ruff, codespell and mypy
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/codespell
	$(VENV)/bin/mypy

format: $(VENV)/.lint  ## format the code with ruff and apply its automatic fixes
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

docs: $(VENV)/.docs $(MERMAID)/.fetched  ## build the site, and run its tutorials; results in out/docs
	$(PY) -m sphinx --builder html --jobs auto --fail-on-warning --keep-going docs out/docs

pictures: $(VENV)/.test  ## take the pictures of the documents again; needs an idle machine
	$(PY) docs/pictures.py

faults: setup  ## inject faults into a simulated robot and measure its reaction; results in out/faults
	$(VENV)/bin/quadvel faults --out out/faults; code=$$?; $(VENV)/bin/python -m quadvel_lab.topic_faults && exit $$code

bench: setup  ## measure the speed of this machine; results in out/bench.json
	$(VENV)/bin/quadvel bench --out out/bench.json

lock: $(PY)  ## rewrite requirements.lock from the bounds in pyproject.toml
	$(PY) -m pip install --quiet --disable-pip-version-check uv
	$(PY) -m uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 --upgrade \
	    --no-annotate --no-emit-index-url --custom-compile-command "make lock" --output-file requirements.lock

clean:  ## remove both environments, out, build products and caches
	rm -rf $(VENV) $(ROS_VENV) out build docs/reference/api .mypy_cache .pytest_cache .ruff_cache *.egg-info

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
	@echo "Installing quadvel and its dependencies into $(VENV) (a few minutes the first time) ..."
	$(PY) $(INSTALL) '.[eval,view]'
	@touch $@

$(VENV)/.lint: $(VENV)/.run
	$(PY) $(INSTALL) '.[eval,view,lint]'
	@touch $@

$(VENV)/.test: $(VENV)/.run
	$(PY) $(INSTALL) '.[eval,view,formats,test,train]'
	@# The vendor's client of a Go2, which drives our board; OpenCV, which it names, is for its video alone.
	$(PY) -m pip install --quiet --disable-pip-version-check --no-deps unitree-sdk2py-dimos==1.0.3
	@touch $@

$(VENV)/.docs: $(VENV)/.run
	$(PY) $(INSTALL) '.[eval,view,docs]'
	@touch $@

$(MERMAID)/.fetched: Makefile
	@command -v npm >/dev/null || { echo "the diagrams of the site need npm; $(APT) npm" >&2; exit 1; }
	rm -rf $(MERMAID) && mkdir -p $(MERMAID)
	cd $(MERMAID) && npm pack --silent mermaid@$(MERMAID_VERSION)
	tar --extract --gzip --file $(MERMAID)/mermaid-$(MERMAID_VERSION).tgz --directory $(MERMAID) --strip-components 1 \
	    --exclude '*.map' package/LICENSE package/dist/mermaid.esm.min.mjs package/dist/chunks/mermaid.esm.min
	rm $(MERMAID)/mermaid-$(MERMAID_VERSION).tgz
	@touch $@

# The wheels are only for x86-64, and our interfaces are compiled: both are checked before the installation.
$(ROS_PY): $(PY) $(BUILD_INTERFACES)
	@$(PY) $(BUILD_INTERFACES) --check
	$(PY) -m venv $(ROS_VENV)

$(ROS_VENV)/.run: $(ROS_PY) $(LOCKED) $(INTERFACES)
	@echo "Installing ROS 2's rclpy, quadvel and its dependencies into $(ROS_VENV) (a few minutes the first time) ..."
	$(ROS_PY) $(INSTALL) '.[eval,view,ros]'
	$(ROS_PY) $(BUILD_INTERFACES)
	@touch $@

$(ROS_VENV)/.test: $(ROS_VENV)/.run
	$(ROS_PY) $(INSTALL) '.[eval,view,formats,ros,test]'
	@touch $@
