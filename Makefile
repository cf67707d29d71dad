# Two commands do everything: `make bench` and `make test`. Both make their own .venv first, once.
VENV   ?= .venv
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN     = $(VENV)/bin
STAMP   = $(VENV)/.installed
ARGS   ?=
RUN    ?= runs/paper

.PHONY: bench reproduce results tune speed faults faults-quick coverage test test-slow smoke lint docs audit format clean help

help:
	@echo "make bench      install, then demonstrations, training, 1,000 noisy scenarios, tables, figures, videos"
	@echo "make reproduce  the results that are committed, from nothing: hours; stop it when you like, it goes on"
	@echo "make results    publish the run in runs/paper (or RUN=...) into docs/results"
	@echo "make tune       search settings, with the same budget for each agent, on validation scenarios"
	@echo "make speed      speed against the peers, into docs/performance.md"
	@echo "make faults     try to break the suite, into docs/reliability.md: about an hour"
	@echo "make faults-quick  a fiftieth of it"
	@echo "make coverage   what the fast tests reach"
	@echo "make test       install, then all fast tests"
	@echo "make test-slow  the tests that take minutes"
	@echo "make smoke      the whole benchmark in miniature"
	@echo "make lint       ruff and mypy"
	@echo "make docs       the documentation as a site, into build/docs; any warning is an error"
	@echo "make audit      known vulnerabilities of what is installed (needs pypi.org)"
	@echo "Extra arguments go through ARGS, for instance: make bench ARGS='--noise-model episode'"

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

bench: $(STAMP)
	$(BIN)/python -m benchmarks.run --agents rise pcbc cppo $(ARGS)

reproduce: $(STAMP)
	$(BIN)/python -m benchmarks.run --preset paper $(ARGS)

results: $(STAMP)
	$(BIN)/python -m benchmarks.publish $(RUN) $(ARGS)

smoke: $(STAMP)
	$(BIN)/python -m benchmarks.run --agents rise pcbc cppo --preset smoke $(ARGS)

tune: $(STAMP)
	$(BIN)/python -m benchmarks.tune --agents rise pcbc cppo $(ARGS)

speed: $(STAMP)
	$(BIN)/python -m benchmarks.speed --docs docs/performance.md --bench-times $(ARGS)

faults: $(STAMP)
	$(BIN)/python -m benchmarks.faults --docs docs/reliability.md $(ARGS)

faults-quick: $(STAMP)
	$(BIN)/python -m benchmarks.faults --quick --out runs/faults-quick $(ARGS) --rows \
	  kill-run kill-checkpoint disk-full mutated-checkpoints mutated-datasets replay save-load resume-training fuzz

coverage: $(STAMP)
	$(BIN)/python -m benchmarks.faults --rows coverage --out runs/coverage $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -n auto $(ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow $(ARGS)

lint: $(STAMP)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/python -m mypy docs/conf.py docs/pictures.py

docs: $(STAMP)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --nitpicky --quiet --jobs auto \
	  --doctree-dir build/doctrees docs build/docs $(ARGS)
	@echo "open build/docs/index.html"

# pip-audit has a venv of its own, so that it changes nothing of what it looks at. --strict: a package that the
# database does not know is an error, else a machine that cannot reach it would find everything in order.
# The package itself and local builds (torch's +cpu) are not on PyPI: the former is left out, the latter lose their mark.
$(VENV)/audit/bin/pip-audit: $(STAMP)
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/python -m pip install --quiet --disable-pip-version-check 'pip-audit>=2.7'

audit: $(VENV)/audit/bin/pip-audit
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/+[a-z0-9.]*$$//' > $(VENV)/audit/installed.txt
	$(VENV)/audit/bin/pip-audit --strict --no-deps --disable-pip -r $(VENV)/audit/installed.txt $(ARGS)

format: $(STAMP)
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

clean:
	rm -rf $(VENV) build docs/reference dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
