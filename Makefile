# Everything a developer runs. `make` alone lists it.
#
# The environment is ./.venv, made from requirements.lock (versions and hashes) on first need and
# reused until pyproject.toml, the lock or the version changes.

PYTHON ?= python3
PYTEST_ARGS ?=
LOCK_ARGS ?=

VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready

# What `make demo` does, once it is set up.
DEMO := $(VENV)/bin/ventbench score submissions/pid_best submissions/pid_robust \
	--out runs/demo --report

# Tests start Python hundreds of times: what it has compiled is kept, also where a shell says not to.
unexport PYTHONDONTWRITEBYTECODE

# Tests take memory in huge pages where the kernel gives them on request, and keep what they took: on
# a virtual machine a page of 4 KiB can cost 100 microseconds, and JAX takes 40,000 to start.
test test-slow: export PYTHONMALLOC := malloc
test test-slow: export GLIBC_TUNABLES := glibc.malloc.hugetlb=1:glibc.malloc.tcache_count=1000:$\
	glibc.malloc.top_pad=16777216:glibc.malloc.trim_threshold=268435456:$\
	glibc.malloc.mmap_threshold=33554432

.DEFAULT_GOAL := help
.PHONY: help setup demo check test test-slow lint format docs lock bench wheel clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "Variables: PYTHON (to make .venv with; $(PYTHON)), PYTEST_ARGS, LOCK_ARGS (--upgrade)"

setup: $(READY) ## make .venv, or bring it up to date

demo: setup ## score the PID submissions on the six lungs: table, report, rerun file
	$(DEMO)

test: check ## ruff, arrows between rooms and the fast tests
	$(PY) -m pytest -n auto --dist loadfile $(PYTEST_ARGS)
	@echo "The fast tests passed. 'make test-slow' runs the proofs that take minutes."

test-slow: setup $(VENV)/.validator ## the tests that take seconds or minutes each
	$(PY) -m pytest -n auto --dist loadfile -m "listed and not slow" $(PYTEST_ARGS) $(if $(PYTEST_ARGS),|| [ $$$$? = 5 ])
	$(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder -m slow $(PYTEST_ARGS) $(SLOW_ROOMS) $(if $(PYTEST_ARGS),|| [ $$$$? = 5 ])

check: setup ## ruff, arrows between rooms and how big they are, changing nothing
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(VENV)/bin/lint-imports --no-cache --no-logo
	$(PY) -m ci.house

lint: check ## the same and pyright, which takes a minute
	$(PY) -m pyright --pythonpath $(PY)

format: setup ## let ruff mend and format the code
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: setup ## build the documentation as a site in runs/site, warnings as errors
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict
	@echo "open runs/site/index.html"

lock: setup ## write requirements.lock anew from pyproject.toml
	$(PY) -m uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 \
		--fork-strategy fewest --generate-hashes --quiet --custom-compile-command "make lock" \
		--output-file requirements.lock $(LOCK_ARGS)
	$(PY) -m uv pip compile --group device --universal --python-version 3.11 --fork-strategy fewest \
		--generate-hashes --quiet --custom-compile-command "make lock" \
		--output-file hardware_eval/device/requirements.txt $(LOCK_ARGS)

# One needs opened challenges, one takes a quarter of an hour for each network, one would write new
# weights.
NO_BENCHMARKS := benchmarks/adapter_calibration.py benchmarks/learned_floor.py \
	benchmarks/train_classifier.py

bench: setup ## every benchmark
	@set -e; for file in $(filter-out $(NO_BENCHMARKS),$(wildcard benchmarks/[a-z]*.py)); do \
		echo "== $$file"; $(PY) $$file; \
	done

wheel: setup ## wheel and source archive in dist/, checked
	rm -rf dist
	$(PY) -m build --no-isolation --outdir dist
	$(PY) -m twine check --strict dist/*
	$(VENV)/bin/check-wheel-contents dist/*.whl

# What checks croissant.json has a dependency without a wheel, so that it is no part of the lock. The
# types of pandas that it brings along would change what `make lint` says.
$(VENV)/.validator: $(READY)
	$(PY) -m uv pip install --quiet --python $(PY) mlcroissant
	$(PY) -m uv pip uninstall --quiet --python $(PY) pandas-stubs
	@touch $@

clean: ## remove what was built; .venv, runs and records stay
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

# Wheels only, each with a hash: nothing is built, so no build tool is fetched unpinned either. Pip
# installs the lock's uv, which installs the rest: from its cache in seconds, else in a minute.
# A Python without pip of its own puts it into .venv.
$(READY): pyproject.toml requirements.lock ventbench/__init__.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		found=$$($(PYTHON) --version 2>/dev/null) || found="no Python"; \
		echo "ventbench needs Python 3.11 or newer; '$(PYTHON)' is $$found." >&2; \
		echo "Name another one: make setup PYTHON=python3.12" >&2; exit 1; }
	@$(PY) -c '' 2>/dev/null || $(PYTHON) -m venv --clear --without-pip $(VENV)
	@echo "Installing the packages of requirements.lock into $(VENV): a minute or two."
	@set -e; \
	pip="$(PYTHON) -m pip --python $(PY)"; \
	$$pip --version >/dev/null 2>&1 || { $(PY) -m ensurepip >/dev/null; pip="$(PY) -m pip"; }; \
	sed -n '/^uv==/,/[^\]$$/p' requirements.lock > $(VENV)/uv.txt; \
	$$pip install --quiet --disable-pip-version-check --progress-bar off \
		--require-hashes --only-binary :all: --requirement $(VENV)/uv.txt; \
	install="$(PY) -m uv pip install --quiet --python $(PY)"; \
	$$install --require-hashes --only-binary :all: --requirement requirements.lock; \
	$$install --no-deps --no-build-isolation --editable .
	@touch $@
