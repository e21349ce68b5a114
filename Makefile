# Each target sets up what it needs. The virtual environment is made once, in .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The tests start hundreds of processes; where bytecode is not kept, each would compile its libraries again.
unexport PYTHONDONTWRITEBYTECODE
# One process per core. A file stays in one process, which starts the file's servers once; the longest files come first.
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder

.PHONY: demo serve test test-fast soak soak-part chaos lint openapi lock sbom bench pictures site clean

# Tools that the project is not built with, apart from what they look at.
TOOLS ?= .tools
# The images' Python and every machine; torch as the tests hold it, and none without the extras of video models.
LOCK = $(TOOLS)/bin/uv pip compile --quiet --python-version 3.13 --universal --generate-hashes --no-annotate \
	--custom-compile-command "make lock" --constraint tests/constraints.txt $(UPGRADE)
CPU_EXTRAS := --extra providers --extra otel --extra mcp --extra objects --extra ray
CUDA_EXTRAS := $(CPU_EXTRAS) --extra wan --extra fp8 --extra local

demo: $(VENV)/.base ## run the main job on an example
	$(BIN)/cow demo --out demo

serve: $(VENV)/.base ## start the server on 127.0.0.1:8000
	$(BIN)/cow serve

test: $(VENV)/.test ## every test but those marked soak
	$(PYTEST) -m "not soak"

test-fast: $(VENV)/.test ## of `make test` those not marked slow
	$(PYTEST) -m "not soak and not slow"

soak: $(VENV)/.test ## every test with every case; chaos, fuzz and property tests ten times as long; public harnesses
	COW_TEST_SCALE=10 $(PYTEST)
	$(MAKE) -C cow-scenes test

soak-part: $(VENV)/.test ## PART=K/N: the K-th of N parts of what `make soak` has and `make test` has not
	COW_TEST_SCALE=10 $(PYTEST) -m "soak or scaled" --part $(PART)

chaos: $(VENV)/.test ## strike servers, databases, networks and disks at random; COW_CHAOS_SEED=N repeats a schedule
	$(BIN)/python -m pytest tests/jobs/test_chaos.py --numprocesses 2 -rA

lint: $(VENV)/.test ## style, layers and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

openapi: $(VENV)/.base ## write openapi.yaml from the app
	$(BIN)/cow openapi > openapi.yaml

lock: $(TOOLS)/.made ## write versions and hashes of what the images install; UPGRADE=--upgrade takes newer ones
	printf "%s\n" "hatchling>=1.27" "unasync>=0.6" | $(LOCK) - --output-file docker/locks/build.txt
	$(LOCK) pyproject.toml $(CPU_EXTRAS) --output-file docker/locks/cpu.txt
	$(LOCK) pyproject.toml $(CUDA_EXTRAS) --output-file docker/locks/cuda.txt

sbom: $(TOOLS)/.made ## write what the images install as CycloneDX, into dist
	mkdir -p dist
	for image in cpu cuda; do $(TOOLS)/bin/cyclonedx-py requirements docker/locks/$$image.txt --pyproject pyproject.toml \
		--output-reproducible --output-file dist/cow-$$image.cdx.json; done

# What `make bench` compares with: the latest release, or any revision that is named.
RELEASE ?= $(shell git describe --tags --abbrev=0 2>/dev/null)

pictures: $(VENV)/.test ## the pictures of README and docs/, from the examples
	$(BIN)/python docs/pictures.py

site: $(VENV)/.site ## the documentation as pages to open without a network: site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

bench: $(VENV)/.base ## the figures of docs/figures.md, then pairs with the last release (RELEASE=REVISION: with another one)
	$(BIN)/python benchmarks/scenes.py examples
	$(BIN)/python benchmarks/answers.py examples
	$(BIN)/python benchmarks/latency.py
	$(BIN)/python benchmarks/profile_stages.py
	$(BIN)/python benchmarks/engine.py
	$(BIN)/python benchmarks/chat.py
	$(if $(RELEASE),$(BIN)/python benchmarks/turns.py $(RELEASE) .,@echo "No release to compare with: name a revision by RELEASE=.")

clean: ## remove what the other targets made
	rm -rf $(VENV) $(TOOLS) demo site dist build $(addprefix cow_service/client/,options.py sync_client.py sync_results.py)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# What an installation makes modules of the SDK from.
TWINS := hatch_build.py $(addprefix cow_service/,client/async_client.py client/async_results.py client/batches.py \
	requests/simulation.py records/reading.py records/values.py)

$(VENV)/.base: pyproject.toml $(TWINS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.site: pyproject.toml tests/constraints.txt $(TWINS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[docs]" --constraint tests/constraints.txt
	touch $@

# A new pip resolves these in a third of the time that the one of Python 3.11 takes. Most of their modules are never imported:
# they are not compiled beforehand.
$(VENV)/.test: pyproject.toml tests/constraints.txt $(TWINS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile --editable ".[test]" --constraint tests/constraints.txt
	touch $(VENV)/.base $(VENV)/.site $@

$(TOOLS)/.made: Makefile
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet uv==0.13.9 cyclonedx-bom==7.5.0
	touch $@
