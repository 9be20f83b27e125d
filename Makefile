# PhysHanDI: everything a fresh machine needs is set up by these targets.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PORT ?= 8080
DATA ?= data
# Without an NVIDIA GPU install torch's CPU build first (docs/getting-started.md); this variable is passed to pip.
TORCH ?= torch==2.13.0
PIP_FLAGS := --quiet --disable-pip-version-check --no-compile -c constraints.txt

.PHONY: install demo test coverage races reliability check fmt bench container test-gpu pictures browser clean

install: $(STAMP)

# uv takes a tenth of pip's processor time for what constraints.txt names; PyTorch, which has a build for
# each kind of machine, comes from where pip is told to look, beside it. Nothing is compiled: of all
# modules that are installed few are used. Where uv finds no packages pip installs them at the end.
export PYTHONDONTWRITEBYTECODE :=
EXTRAS := [dev,synth,capture,models,newton,usd]
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	sed '/^torch==/d; /^# Other/,$$d' constraints.txt >$(VENV)/packages
	index="$${PIP_INDEX_URL:-$$($(BIN)/python -m pip config get global.index-url 2>/dev/null)}"; \
	uv="$(BIN)/uv pip install --quiet $${index:+--default-index $$index} -c constraints.txt"; \
	{ $(BIN)/python -m pip install $(PIP_FLAGS) uv && $$uv --no-deps -r $(VENV)/packages -e .; } & \
	$(BIN)/python -m pip install $(PIP_FLAGS) --no-deps $(TORCH) && wait && \
	{ $$uv "physhandi$(EXTRAS)" || $(BIN)/python -m pip install $(PIP_FLAGS) -e ".$(EXTRAS)"; }
	touch $@

demo: install
	$(BIN)/physhandi doctor
	$(BIN)/physhandi serve --host 127.0.0.1 --port $(PORT) --data-dir $(DATA) --demo

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyrefly check --python-interpreter-path $(BIN)/python

fmt: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Each of several processes would compile the same modules; so one does, once.
$(VENV)/.compiled: $(STAMP)
	$(BIN)/python -m pytest --collect-only -q >/dev/null
	touch $@

# Three processes keep two processors busy: one has all browsers, which wait for pictures and answers
# as often as they compute, and beside each other hold each other up.
test: install browser $(VENV)/.compiled
	$(BIN)/python -m pytest -n 3 --no-loadscope-reorder

# The same tests, with every line counted that they go through: a fifth slower.
coverage: install browser $(VENV)/.compiled
	rm -f .coverage .coverage.*
	$(BIN)/python -m pytest -n 3 --no-loadscope-reorder --cov --cov-report=term

# Live scenes, jobs and pages while their threads are held up at random.
races: install
	PYTHONPATH=tests $(BIN)/python -m pytest -n 2 --dist loadfile -p support.random_pauses tests/app

# Kills, full disks and impatient clients by the hundred; takes hours. Writes docs/reliability.md.
reliability: install
	PYTHONPATH=tests $(BIN)/python -m reliability --page

# The README's pictures, made by the browser tests.
pictures: install browser
	PHYSHANDI_PICTURES=docs/images $(BIN)/python -m pytest -q tests/e2e

# The Dockerfile's steps in a new Debian, as root and without Docker; then its server and health check.
CONTAINER ?= /tmp/physhandi-container
container:
	$(PYTHON) tests/container_check.py $(CONTAINER) $(CONTAINER_FLAGS)

test-gpu: install
	$(BIN)/python -m pytest -m gpu

bench: install
	$(BIN)/physhandi benchmark rollout --json

# The browser tests drive Debian's chromium; without its windows they take two thirds of the time.
browser:
	@command -v chromium-headless-shell >/dev/null || { \
	  [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -y -qq --no-install-recommends \
	    chromium-headless-shell libegl-mesa0 libgl1-mesa-dri libgl1 libegl1 >/dev/null; \
	} || command -v chromium >/dev/null || { \
	  echo "The browser tests need chromium: install it with your package manager." >&2; exit 1; }

clean:
	rm -rf $(VENV) .coverage .coverage.* .pytest_cache .ruff_cache
