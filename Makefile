# Every habit is a verb. Each target makes its own environment in .venv first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What running needs is installed; development's packages are as well.
RUNTIME := $(VENV)/.runtime
STAMP := $(VENV)/.development
# Our other distributions, each in a folder.
PARTS := client lab viewers
# Tools of the supply chain, apart: what they need must not move what we run.
TOOLS := $(VENV)/tools
# Our kernels want one thread each; more processes, not more threads, use more processors.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Bytecode is kept: the tests start hundreds of processes, and each would parse our modules anew.
unexport PYTHONDONTWRITEBYTECODE
# Tests wait for real processes half of their time: twice as many as there are processors.
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(shell echo $$((2 * $$(env -u OMP_NUM_THREADS nproc))))

.PHONY: help demo test pytest test-thorough test-portable test-postgres lint kernels bytecode goldens format bench \
	screenshots docs docs-serve soak siege fleet models lock sbom advisories dist clean

help:
	@echo "make demo    find frames among others with their pose, and draw one, into demo/ [DATASET=folder]"
	@echo "make test    lint, types, import contracts and the tests"
	@echo "make test-thorough  tests that make test leaves out, as they take minutes or seldom fail"
	@echo "make test-portable  numeric tests as other processors compute them, one after another [TARGET=generic]"
	@echo "make test-postgres  the tests of what stands on the database, on PostgreSQL"
	@echo "make goldens  rewrite tests/golden and docs/settings.md after an intended change; read the diff"
	@echo "make lint    lint, types and import contracts only, of the dashboard's JavaScript too"
	@echo "make bench   what each stage costs, beside others"
	@echo "make screenshots  every page of the dashboard, light and dark, into out/screenshots"
	@echo "make docs    the documentation as a site, into out/site; a dead link is an error"
	@echo "make docs-serve  the same at http://127.0.0.1:8009, made anew when a page changes"
	@echo "make soak    robots on SQLite, 100 kills, a full disk; rewrites its part of docs/fault_injection.md"
	@echo "make siege   broken uploads, every operation, tenants that attack; likewise"
	@echo "make fleet   robots on PostgreSQL with a standby, parts killed; likewise"
	@echo "make models  train the presets that ship with the package (minutes)"
	@echo "make lock    write requirements*.lock anew from pyproject.toml [UPGRADE=1 for the newest]"
	@echo "make sbom    the packages of the service and its image, as CycloneDX, into out/"
	@echo "make dist    wheels and source distributions of all packages, tried in an empty environment"
	@echo "make advisories  known vulnerabilities of all locked packages; needs a network"

# What running needs comes first: `make demo` asks for no more. Development adds its packages.
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

# Compiled once here, and not by each process of the tests for itself.
kernels: $(STAMP)
	@$(BIN)/python -c 'from sceneprint.cli.preparation import prepare_presets; \
		from sceneprint.settings import Settings; prepare_presets(Settings(), clouds=True)'

# Nor does each compile the tests, whose assertions pytest writes anew, where nobody has yet; what
# is wrong with them is said by the run itself.
bytecode: $(STAMP)
	@test -d tests/__pycache__ || $(BIN)/python -m pytest --collect-only -q > /dev/null || true

# The linters run beside the kernels and the first tests; where one fails, the target fails too.
test: $(STAMP)
	@$(MAKE) --no-print-directory -j2 lint pytest

# Files stay whole, as their fixtures are dear, and so do folders that share a service; their order
# is that of tests/conftest.py.
pytest: kernels bytecode
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# What takes long and seldom breaks: the image built step by step, whole recordings, benchmarks.
test-thorough: $(STAMP) kernels
	$(BIN)/python -m pytest -n auto --dist loadfile -m thorough

# Bounds that hold on this processor alone show here; the script says what each target changes.
test-portable: $(STAMP)
	$(BIN)/python tools/portable_tests.py $(TARGET)

# What PostgreSQL does as well, on it: tests/on_postgres leads each process there.
test-postgres: $(STAMP) kernels
	SCENEPRINT_TEST_DATABASE=postgresql PYTHONPATH=$(CURDIR)/tests/on_postgres \
		$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder \
		$(addprefix tests/,store engine service client worker cli_service maintenance dashboard)

# What tests/test_golden.py compares with, after an intended change: read the diff.
goldens: $(STAMP) kernels
	SCENEPRINT_UPDATE_GOLDEN=1 $(BIN)/python -m pytest -q tests/test_golden.py
	$(BIN)/python -m tools.settings_page

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/python -m benchmarks

screenshots: $(STAMP)
	$(BIN)/python -m benchmarks.screenshots --out out/screenshots

# mkdocs-material announces its successor at each start
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

fleet: $(STAMP) kernels
	$(SOAK) fleet fleet-asynchronous fleet-delays fleet-crowd

models: $(STAMP)
	$(BIN)/sceneprint train --preset depth --out sceneprint/presets/depth.safetensors
	$(BIN)/sceneprint train --preset lidar --out sceneprint/presets/lidar.safetensors
	$(BIN)/sceneprint train --preset paper --out sceneprint/presets/paper.safetensors

$(TOOLS)/.installed: requirements-tools.lock requirements-uv.lock tools/install
	@tools/install $(PYTHON) $(TOOLS) requirements-tools.lock
	@touch $@

# Every version with the hashes of all its files, for every platform and Python from 3.11 on. Pins
# that are there stay, unless UPGRADE is set. Without open3d, what running needs and the image has
# (docs/dependencies.md); with what the lab and the viewers
# need, `make demo`; with open3d too, development.
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

# It asks OSV about each version that is locked, so it installs nothing.
advisories: $(TOOLS)/.installed
	@for of in -dev -tools -uv; do \
		$(TOOLS)/bin/pip-audit --disable-pip --require-hashes --vulnerability-service osv \
			--requirement requirements$$of.lock || failed=1; \
	done; exit $${failed:-0}

# The wheels are built from the source distributions: a file that these lack shows at once.
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
