# Two commands for a fresh Debian-like machine with Python and make: `make demo` and `make test`.
# Each does all its own set-up: the virtual environment, the Python packages, and the system packages where it may.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/pip install --quiet --disable-pip-version-check --constraint requirements.lock

# What the tests need: GL as the check of the CPU renderer, a machine to boot Linux in, and Debian's own tools in it.
APT_TEST := libegl1 libgl1 libgl1-mesa-dri qemu-system-x86 busybox-static usbip cpio kmod libusb-1.0-0 v4l-utils make can-utils iproute2 gcc libc6-dev gcc-arm-none-eabi qemu-system-arm chromium tshark aravis-tools-cli gir1.2-aravis-0.8 python3-gi linuxptp xvfb python3-tk

# The tests start hundreds of processes, each of which would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

# `.ci/times.py` has the processor time of each part, and compares it with the budget in house.toml.
TIMED := $(PYTHON) .ci/times.py

.PHONY: checks speed speed-short demo smoke test long long-here long-guests fast laboratory programs guests check packages prepare docs docs/rigs.md bench clean

# Stars by two cameras: on USB/IP, read by evstim's own receiver, and on GigE Vision, read by an unmodified driver.
demo: $(VENV)/.installed
	$(BIN)/evstim demo
	$(BIN)/evstim demo stars-gige

# In parts, each a target of its own and a job of the forge's workflow. What QEMU emulates has the machine to itself:
# beside the programs both took two minutes longer. Debian's packages come beside the checks and the kernels.
test:
	rm -rf .cache/test-times
	$(MAKE) -j3 packages check prepare
	$(MAKE) fast
	$(MAKE) laboratory
	$(MAKE) programs
	$(MAKE) guests
	$(MAKE) speed-short
	$(TIMED)

# The processor time of a step, beside the commit and the ratios in speed.toml; and, without that commit, of four rigs.
speed: prepare
	$(BIN)/python .ci/speed.py --base

speed-short: prepare
	$(BIN)/python .ci/speed.py

# Light to decoded events over each link, a recording, the live page, a mistake that is refused: a minute.
smoke: prepare
	$(BIN)/python -m pytest tests/test_smoke.py -n 2

# The kernels are compiled before: two processes would each compile them.
fast: prepare
	TEST_PART=fast $(BIN)/pytest -m "not guest and not arm and not anew and not system and not long" --ignore tests/laboratory -n 2 --dist loadfile

# What judges the emulator, in laboratory/.
laboratory: prepare
	TEST_PART=laboratory $(BIN)/pytest tests/laboratory -m "not guest and not arm and not anew and not long" -n 2 --dist loadfile --timeout 900

# Whole programs.
programs: prepare
	TEST_PART=programs $(BIN)/pytest -m "system and not guest and not arm and not anew and not long" --ignore tests/laboratory -n 2 --dist loadfile --timeout 900

guests: packages prepare
	TEST_PART=guests $(BIN)/pytest -m "(guest or arm) and not anew and not long" --timeout 900

# What `make test` leaves out: the other clients and models, longer runs, fresh compilations. For a release, and after a
# change of a camera or of a kernel. Both parts run, whatever fails in the first.
long:
	rm -rf .cache/test-times
	$(MAKE) -k long-here long-guests
	$(TIMED)

long-here: packages prepare
	TEST_PART=long $(BIN)/pytest -m "(long or anew) and not guest" -n 2 --dist loadfile --timeout 1800

long-guests: packages prepare
	TEST_PART=long-guests $(BIN)/pytest -m "(long or anew) and guest" --timeout 1800

packages:
	@.ci/apt $(APT_TEST)

prepare: $(VENV)/.installed-test
	$(TIMED) prepare $(BIN)/evstim doctor --prepare

check: $(VENV)/.installed-test
	$(TIMED) check $(MAKE) checks

checks:
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python .ci/words.py
	$(BIN)/python .ci/house.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs: $(VENV)/.installed-test
	$(BIN)/mkdocs serve

# Tables of all keys of a rig, from the types that load rigs.
docs/rigs.md: docs/rig_reference.py $(VENV)/.installed-test
	$(BIN)/python docs/rig_reference.py

bench: $(VENV)/.installed
	$(BIN)/evstim bench

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "evstim needs Python 3.11 or newer; set PYTHON=")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml requirements.lock | $(VENV)/bin/python
	$(PIP) --editable '.[report,demo]'
	@touch $@

# Modules are compiled at their first import: many of these packages are imported by few tests.
$(VENV)/.installed-test: pyproject.toml requirements.lock | $(VENV)/bin/python
	$(PIP) --no-compile --editable '.[report,demo,test]'
	@touch $(VENV)/.installed $@

clean:
	rm -rf $(VENV) .cache site dist
