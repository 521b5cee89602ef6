# make demo | test | slow | counterparts | mutants | bench | check | format | outages | faults | fuzz | hazards | references | audit | browser | deceit | docs: each makes .venv and installs what it needs; a second time costs nothing.

PYTHON ?= python3
BIN    := .venv/bin
STAMP  := .venv/.installed
AUDIT  := .venv/audit
DOCS   := .venv/docs
DEMO   := demo

# Bytecode is kept whatever the shell says: the tests start some hundred processes, each of which would compile it all anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test slow counterparts mutants bench check types replays collected format install outages faults fuzz hazards references audit browser deceit docs
.DEFAULT_GOAL := test

demo: $(STAMP)
	@$(BIN)/stillbed simulate data/scenarios/demo.toml -o $(DEMO) --force

test: $(STAMP)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

slow: $(STAMP)
	HYPOTHESIS_PROFILE=many $(BIN)/python -m pytest -m "slow or law" --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Machines that others wrote: what can be installed is, what is missing is skipped, with what to install.
COUNTERPARTS := tests/test_arm_laws.py tests/test_gcode.py tests/test_franka_live.py tests/test_urdf.py tests/test_genicam.py tests/test_rtsp.py
PRINTER := OctoPrint==1.11.8
CAMERAS := aravis-tools gir1.2-aravis-0.8 python3-gi nftables faketime gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-good gstreamer1.0-plugins-ugly

counterparts: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[counterparts]'
	@$(call apt,$(CAMERAS),command -v arv-fake-gv-camera-0.8)
	test -x .octoprint/bin/python || $(PYTHON) -m venv .octoprint
	.octoprint/bin/python -m pip install --quiet '$(PRINTER)' # in a place of its own: AGPL, and with pins of its own
	$(BIN)/python -m pytest -m "slow or not slow" -rs $(COUNTERPARTS)

mutants: $(STAMP)
	$(BIN)/python -m tests.mutants

bench: $(STAMP)
	$(BIN)/python -m tests.campaigns --all

outages: $(STAMP)
	$(BIN)/python -m tests.campaigns outages --count 1000 --seed 1 -o out/outages --force

faults: $(STAMP)
	$(BIN)/python -m tests.campaigns faults --count 10000 --seed 1 --jobs 2 --log out/faults.csv -o out/faults --force

fuzz: $(STAMP)
	$(BIN)/python -m tests.campaigns fuzz --count 1000000 --jobs 2 --log out/fuzz.csv -o out/fuzz --force

deceit: $(STAMP)
	$(BIN)/python -m tests.campaigns deceit --count 200 --seed 1 --jobs 2 -o out/deceit --force

hazards: $(STAMP)
	$(BIN)/python -m tests.hazard_table --run

# Types and replays at a time, on two cores; the rules of the house are tests, so where all tests are asked for too they come there.
# What each of the tests' processes would else do for itself on a fresh clone, a minute and a half, is done once, beside the types.
check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.hazard_table --check
	$(MAKE) --jobs 2 --output-sync types replays $(if $(filter test,$(MAKECMDGOALS)),collected)
	$(if $(filter test,$(MAKECMDGOALS)),,$(BIN)/python -m pytest tests/test_floors.py tests/test_shipped.py)

# Loops are compiled and tests' assertions rewritten, for good. What cannot be collected, `make test` tells.
collected: $(STAMP)
	-@$(BIN)/python -m pytest --collect-only >/dev/null

types: $(STAMP)
	$(BIN)/mypy

replays: $(STAMP)
	$(BIN)/python -m tests.process_replay

# What comes of the reference recordings now is what is to come of them: for a change that is meant.
references: $(STAMP)
	$(BIN)/python -m tests.process_replay --update

# pip-audit has a place of its own: what it needs is nothing that stillbed needs.
audit:
	@test -x $(AUDIT)/bin/pip-audit || { $(PYTHON) -m venv $(AUDIT) && $(AUDIT)/bin/python -m pip install --quiet pip-audit==2.10.1; } || \
		echo "pip-audit cannot be installed; is there a network?"
	@$(PYTHON) -m tests.audit $(AUDIT)/bin/pip-audit

# The reference of all names, from their docstrings. pdoc has a place of its own, as pip-audit has.
docs: $(STAMP)
	@test -d $(DOCS) || $(BIN)/python -m pip install --quiet --constraint constraints.txt --target $(DOCS) pdoc==16.0.0 markdown2==2.5.5
	@rm -rf out/api && PYTHONPATH=$(DOCS) OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.api_links out/api

# The operator's page is tested in Chromium; where there is none those tests are skipped, and say so.
ANY_CHROMIUM := command -v chromium-headless-shell || command -v chromium || command -v chromium-browser || command -v google-chrome

browser:
	@$(call apt,chromium-headless-shell fonts-liberation,$(ANY_CHROMIUM))
	@$(call apt,chromium,$(ANY_CHROMIUM))

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "stillbed needs Python 3.11 or newer; try: make PYTHON=python3.12"; exit 1; }
	@$(call apt,python3-venv,$(PYTHON) -c 'import ensurepip')
	@echo "installing into .venv what stillbed needs: some minutes, once"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]' # bytecode comes with the first import
	@$(call apt,libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0,$(BIN)/python -c 'import open3d')
	@touch $@

# $(call apt,PACKAGES,CHECK): where CHECK fails, install PACKAGES if we may, else say the one line to run, and go on.
define apt
if ! { $(2); } >/dev/null 2>&1; then \
	if [ "$$(id -u)" = 0 ]; then sudo=; else sudo="sudo -n"; fi; \
	if command -v apt-get >/dev/null && { [ -z "$$sudo" ] || $$sudo true 2>/dev/null; }; then \
		echo "installing $(1)"; \
		$$sudo apt-get update -qq && DEBIAN_FRONTEND=noninteractive $$sudo apt-get install -y -qq $(1) >/dev/null || \
			echo "that failed; please run: sudo apt-get install -y $(1)"; \
	else \
		echo "please run: sudo apt-get install -y $(1)"; \
	fi; \
fi
endef
