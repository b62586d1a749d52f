# make demo    a loop is retuned before your eyes      make test    every test and every check
# make setup   the Python environment in .venv         make check   types, style, import directions, packages
# make bench   every benchmark, in one table           make validate    the five papers, recomputed
# make faults  every fault in every stage, live: an hour  make simulate    thousands of simulated disasters
# make hostile an hour of hostile clients, live           make docs  the documents as a site
# make compose-test    the containers, with a real engine      make bench-tuning    how well "fast" tunes 121 plants

# Debian builds its Python with optimisations that pyenv leaves out: the tests take up to a sixth less processor time.
PYTHON ?= $(shell /usr/bin/python3 -c "import ensurepip, sys; assert sys.version_info > (3, 11)" 2>/dev/null && echo /usr/bin/)python3
VENV := .venv
BIN := $(VENV)/bin
# A compiler: user-mode Linux alone runs on no processor with AMX (tools/uml_xstate.c).
UML := user-mode-linux iproute2 $(shell grep -qs amx_tile /proc/cpuinfo && echo gcc libc6-dev)
DEBIAN := $(UML) tshark can-utils postgresql systemd chromium-headless-shell prometheus curl $(shell command -v npm >/dev/null || echo nodejs npm)
ENGINE := docker.io docker-compose
BESIDE := $(UML) debootstrap e2fsprogs

.PHONY: setup demo test compose-test check docs bench bench-tuning validate faults simulate hostile system clean

setup: $(VENV)/.installed

# Pinned in constraints.txt: the same versions tomorrow as today.
$(VENV)/.installed: pyproject.toml constraints.txt
	@sh tools/make-venv $(PYTHON) $(VENV) dev
	@touch $(VENV)/.demo $@

# The demo needs no linters and no documents.
$(VENV)/.demo: pyproject.toml constraints.txt
	@sh tools/make-venv $(PYTHON) $(VENV) service,plot
	@touch $@

# DEMO="--method fast" shows one method alone.
demo: $(VENV)/.demo
	$(BIN)/loopwright demo $(DEMO)

# Installs the Debian packages that the tests need. Without root or apt-get it prints the line to type.
system:
	@sh tools/system-packages $(DEBIAN)

# THEN is a command that runs beside the tests once those on a bus are through, as continuous integration gives one.
test: setup system
	tools/run-tests $(BIN)/python $(THEN)

# Where there is no container engine, one is installed as the packages above are, and runs for this test alone.
compose-test:
	@engine=; docker info >/dev/null 2>&1 || engine="$(ENGINE)"; \
	[ -z "$$engine" ] && [ "$$(id -u)" != 0 ] || sh tools/system-packages $$engine $(BESIDE)
	$(PYTHON) tools/compose-test

check: setup
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/deno check --quiet service/api/web/static/js
	$(BIN)/deno lint --quiet
	$(BIN)/python tools/audit_dependencies.py

# The documents as a site, in build/docs; fails on a link that leads nowhere.
docs: setup
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -n docs build/docs
	@echo build/docs/index.html

# Without them the others are measured, and the table says what was not.
bench: setup
	@sh tools/system-packages $(UML) postgresql chromium
	$(BIN)/python -m benchmarks

# Writes docs/validation.md and its plots; fails when a number of a paper leaves its tolerance.
validate: setup
	$(BIN)/python -m validation

# Writes docs/faults.md; fails on an unsafe ending. FAULTS="--faults locked --stages relay" repeats a part of the table.
faults: setup
	@sh tools/system-packages postgresql
	$(BIN)/python -m tests.faults $(FAULTS)

# Simulated disasters, a few a second on each core; fails on a bad one. SEEDS=20000 WRITE=1 writes docs/simulation.md.
SEEDS ?= 2000
simulate: setup
	$(if $(WRITE),,$(BIN)/python -m tests.simulation --every-call)
	$(BIN)/python -m tests.simulation --seeds $(SEEDS) $(if $(WRITE),--write)

# Hostile clients and costly work at once beside live tests; fails where anything of them shows. HOSTILE="--minutes 5"
hostile: setup
	$(BIN)/python -m tests.hostile $(HOSTILE)

# Long; BENCH="--plants 20 --seeds 1" limits it, BENCH="--method setpoint" is for pulses of the set-point.
bench-tuning: setup
	$(BIN)/python -m benchmarks.tuning $(BENCH)

clean:
	rm -rf $(VENV) *.egg-info
