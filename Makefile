# Two commands: `make demo` and `make test`. Both make the virtual environment first; nothing else is needed but
# Python 3.11 or newer (name another with PYTHON=python3.12).
PYTHON ?= python3
# Of `make soak`: machine hours, and the processes that share them.
HOURS ?= 24
PROCESSES ?= 2
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test lint vcan slow bench soak clean

demo: $(VENV)/installed
	$(BIN)/drive-gateway demo

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

vcan: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m vcan

slow: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m slow -n 2 --dist loadfile

bench: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m bench -s

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("drive-gateway needs Python 3.11 or newer, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"

$(VENV)/installed: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --group dev
	touch $@

soak: $(VENV)/installed-dev
	$(BIN)/python tests/helpers/soak.py --hours $(HOURS) --processes $(PROCESSES) --json soak.json

clean:
	rm -rf $(VENV)
