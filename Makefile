# The project's verbs. Each sets up what it needs: an environment in .venv, pinned dependencies, and
# a release build of the native core. Needs Python 3.11+, a C compiler and Rust.

PYTHON ?= python3
BIN := .venv/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
RUST := Cargo.toml Cargo.lock $(shell find crates -name '*.rs' -o -name Cargo.toml)
CRATES := --workspace --exclude holdfast-binding

.PHONY: run test lint format bench docs lock clean
.DELETE_ON_ERROR:

run: .venv/core.stamp
	@exec $(BIN)/holdfast run examples/plant.yaml

test: .venv/core.stamp .venv/dev.stamp
	cargo test --locked --quiet $(CRATES)
	$(BIN)/pytest

lint: .venv/core.stamp .venv/dev.stamp
	cargo fmt --check
	cargo clippy --locked --quiet --workspace --all-targets -- -D warnings
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest holdfast._core

format: .venv/dev.stamp
	cargo fmt
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# NAME is a benchmark of benches/, BENCH its options.
NAME ?= server
bench: .venv/core.stamp .venv/dev.stamp
	cargo build --locked --quiet --release -p holdfast-benches
	$(BIN)/python benches/$(NAME).py $(BENCH)

# Writes what is made from the program: the schema of the configuration.
docs: .venv/core.stamp
	$(BIN)/holdfast schema > docs/config.schema.json
	$(BIN)/holdfast scan --schema > docs/scanner.schema.json

# Pins the newest versions that requirements/*.in allow.
lock: .venv/dev.stamp
	for set in run dev; do $(BIN)/uv pip compile --quiet --upgrade --universal \
	  --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --no-annotate \
	  --output-file requirements/$$set.lock requirements/$$set.in; done
	cargo update

clean:
	rm -rf .venv target build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	rm -f python/holdfast/_core.*.so

.venv/run.stamp: requirements/run.lock
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r $<
	@touch $@

.venv/dev.stamp: requirements/dev.lock .venv/run.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r $<
	@touch $@

.venv/core.stamp: $(RUST) pyproject.toml .venv/run.stamp
	PIP_QUIET=1 $(BIN)/python -m maturin develop --release --locked --quiet
	@touch $@
