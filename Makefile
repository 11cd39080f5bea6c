# Each target first creates or updates the environment in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Stamps of the installed packages: those of the product, and those of development.
RUNTIME := $(VENV)/.runtime
STAMP := $(VENV)/.development
# Folders of the other distributions.
PARTS := client lab viewers
# Tools of the supply chain, in a separate environment so that they do not change our packages.
TOOLS := $(VENV)/tools
# Each process uses one thread; tests run in parallel processes.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Bytecode is stored, since the tests start hundreds of processes that import the same modules.
unexport PYTHONDONTWRITEBYTECODE
# Tests spend part of their time waiting for other processes, so three run on two processors. Each
# costs its imports, kernels and servers, fifteen seconds of processor.
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(shell echo $$(((3 * $$(env -u OMP_NUM_THREADS nproc) + 1) / 2)))

.PHONY: help demo test pytest test-thorough test-portable test-postgres lint kernels bytecode goldens format bench \
	screenshots docs docs-serve soak faults siege fleet models lock sbom advisories dist clean

help:
	@echo "make demo    localize frames in a demo map, and draw a match, into demo/ [DATASET=folder]"
	@echo "make test    lint, types, import contracts and ordinary tests"
	@echo "make test-thorough  tests that 'make test' omits because they take minutes or rarely fail"
	@echo "make test-portable  numeric tests with the arithmetic of other processors [TARGET=generic]"
	@echo "make test-postgres  tests of everything that uses the database, on PostgreSQL"
	@echo "make goldens  rewrite tests/golden and docs/settings.md after an intended change; read the diff"
	@echo "make lint    lint, types and import contracts, including the dashboard's JavaScript"
	@echo "make bench   cost of each stage beside references"
	@echo "make screenshots  screenshots of all dashboard pages, light and dark, into out/screenshots"
	@echo "make docs    documentation site, into out/site; a dead link is an error"
	@echo "make docs-serve  documentation site at http://127.0.0.1:8009, rebuilt after changes"
	@echo "make soak    robots on SQLite, 100 kills, a full disk; updates docs/fault_injection.md"
	@echo "make faults  a fault at every call that writes, on both databases; updates the same page"
	@echo "make siege   broken uploads, every operation, attacking tenants; updates the same page"
	@echo "make fleet   robots on PostgreSQL with a standby, and kills; updates the same page"
	@echo "make models  train the presets that ship with the package (minutes)"
	@echo "make lock    update requirements*.lock from pyproject.toml [UPGRADE=1 for the newest]"
	@echo "make sbom    list of the packages of the service and its image, as CycloneDX, into out/"
	@echo "make dist    wheels and source distributions of all packages, tested in an empty environment"
	@echo "make advisories  known vulnerabilities of all locked packages; requires a network"

# `make demo` installs only the packages of the product; other targets add those of development.
$(RUNTIME): requirements.lock requirements-lab.lock requirements-uv.lock pyproject.toml \
		$(addsuffix /pyproject.toml,$(PARTS)) tools/install
	@tools/install $(PYTHON) $(VENV) requirements-lab.lock client . lab viewers
	@touch $@

$(STAMP): $(RUNTIME) requirements-dev.lock
	@tools/install $(PYTHON) $(VENV) requirements-dev.lock
	@touch $@

demo: $(RUNTIME)
	$(BIN)/sceneprint demo --out demo $(if $(DATASET),--dataset "$(DATASET)")

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 -p sceneprint_client
	$(BIN)/lint-imports --no-logo
	@tools/javascript/check

# Compile kernels once, instead of in each test process.
kernels: $(STAMP)
	@$(BIN)/python -c 'from sceneprint.cli.preparation import prepare_presets; \
		from sceneprint.settings import Settings; prepare_presets(Settings(), clouds=True)'

# Compile the tests once, with the assertions that pytest rewrites. The test run reports any errors.
bytecode: $(STAMP)
	@test -d tests/__pycache__ || $(BIN)/python -m pytest --collect-only -q > /dev/null || true

# The linters run in parallel with the tests; the target fails if either fails.
test: $(STAMP)
	@$(MAKE) --no-print-directory -j2 lint pytest

# A file runs in one process, since its fixtures are expensive, and so does a folder with a shared
# service; tests/conftest.py sets the order.
pytest: kernels bytecode
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# Slow tests that rarely fail: steps of the image build, whole recordings, benchmarks.
test-thorough: $(STAMP) kernels
	$(BIN)/python -m pytest -n auto --dist loadfile -m thorough

# Detects bounds that hold only on this processor; the script describes the targets.
test-portable: $(STAMP)
	$(BIN)/python tools/portable_tests.py $(TARGET)

# Run the database's tests on PostgreSQL; tests/on_postgres redirects each process.
test-postgres: $(STAMP) kernels
	SCENEPRINT_TEST_DATABASE=postgresql PYTHONPATH=$(CURDIR)/tests/on_postgres \
		$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder \
		$(addprefix tests/,store engine service client worker cli_service maintenance dashboard)

# Update the reference files of tests/test_golden.py after an intended change; read the diff.
goldens: $(STAMP) kernels
	SCENEPRINT_UPDATE_GOLDEN=1 $(BIN)/python -m pytest -q tests/test_golden.py
	$(BIN)/python -m tools.pages

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/python -m benchmarks

screenshots: $(STAMP)
	$(BIN)/python -m benchmarks.screenshots --out out/screenshots

# Suppresses the announcement of mkdocs-material's successor.
docs: export NO_MKDOCS_2_WARNING = 1
docs: $(STAMP)
	$(BIN)/python -m mkdocs build --strict

docs-serve: export NO_MKDOCS_2_WARNING = 1
docs-serve: $(STAMP)
	$(BIN)/python -m mkdocs serve --dev-addr 127.0.0.1:8009 --watch tools/site

SOAK = $(BIN)/python -m benchmarks.soak --page docs/fault_injection.md

soak: $(STAMP) kernels
	$(SOAK) soak soak-crowd

siege: $(STAMP) kernels
	$(SOAK) siege

faults: $(STAMP) kernels
	$(BIN)/python -m tests.faults --page docs/fault_injection.md

fleet: $(STAMP) kernels
	$(SOAK) fleet fleet-asynchronous fleet-delays fleet-crowd

models: $(STAMP)
	$(BIN)/sceneprint train --preset depth --out sceneprint/presets/depth.safetensors
	$(BIN)/sceneprint train --preset lidar --out sceneprint/presets/lidar.safetensors
	$(BIN)/sceneprint train --preset paper --out sceneprint/presets/paper.safetensors

$(TOOLS)/.installed: requirements-tools.lock requirements-uv.lock tools/install
	@tools/install $(PYTHON) $(TOOLS) requirements-tools.lock
	@touch $@

# Versions with hashes of all their files, for every platform and Python from 3.11. Existing pins stay
# unless UPGRADE is set. requirements.lock holds the packages of the product and its image, without
# open3d (docs/dependencies.md); -lab adds those of the lab and the viewers, -dev those of
# development with open3d.
COMPILE = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-header --no-annotate --no-emit-index-url --no-emit-package sceneprint-client \
	$(if $(UPGRADE),--upgrade)

lock: $(RUNTIME)
	echo open3d | $(COMPILE) --extra build --extra ros --excludes /dev/stdin \
		--output-file requirements.lock pyproject.toml
	$(COMPILE) --no-deps --constraint requirements.lock --no-emit-package sceneprint \
		--output-file requirements-lab.lock lab/pyproject.toml viewers/pyproject.toml
	sed -i '1i -r requirements.lock' requirements-lab.lock
	$(COMPILE) --extra dev --constraint requirements.lock --no-emit-package sceneprint \
		--output-file requirements-dev.lock pyproject.toml lab/pyproject.toml viewers/pyproject.toml
	$(COMPILE) --group tools --output-file requirements-tools.lock
	$(COMPILE) --group uv --output-file requirements-uv.lock

sbom: $(TOOLS)/.installed
	@mkdir -p out
	@$(TOOLS)/bin/cyclonedx-py requirements requirements.lock --pyproject pyproject.toml \
		--output-reproducible --output-format JSON --output-file out/sbom.cdx.json
	@echo out/sbom.cdx.json

# Queries OSV for each locked version, without an installation.
advisories: $(TOOLS)/.installed
	@for of in -dev -tools -uv; do \
		$(TOOLS)/bin/pip-audit --disable-pip --require-hashes --vulnerability-service osv \
			--requirement requirements$$of.lock || failed=1; \
	done; exit $${failed:-0}

# The wheels are built from the source distributions, which shows files that these lack.
dist: $(STAMP)
	rm -rf dist
	for of in . $(PARTS); do (cd $$of && $(CURDIR)/$(BIN)/python -c \
		'import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])' \
		$(CURDIR)/dist > /dev/null) || exit 1; done
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist dist/*.tar.gz
	@tools/install $(PYTHON) dist/try requirements-lab.lock
	dist/try/bin/python -m pip install --quiet --no-deps dist/*.whl
	cd dist && try/bin/sceneprint demo --out demo
	@rm -rf dist/try dist/demo && ls -l dist

clean:
	rm -rf $(VENV) build dist out demo *.egg-info $(addsuffix /build,$(PARTS)) \
		$(addsuffix /*.egg-info,$(PARTS)) tools/javascript/node_modules
