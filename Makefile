# The project's verbs. Each sets up what it needs: an environment in .venv, pinned dependencies, and
# a release build of the native core. Needs Python 3.11+; Rust and a C compiler are downloaded for this
# checkout where the machine has none.

PYTHON ?= python3
BIN := .venv/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
RUST := Cargo.toml Cargo.lock $(shell find crates -name '*.rs' -o -name Cargo.toml)
CRATES := -p holdfast-memory -p holdfast-protocol -p holdfast-journal -p holdfast-engine
PROTOCOL := -p holdfast-protocol
NO_STD := crates/protocol/tests/no_std/Cargo.toml
FUZZ := fuzz/Cargo.toml
BARE_METAL := thumbv7em-none-eabi
PEERS := tests/peers/drivers
VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml)
TOOLCHAIN := .cache/toolchain.stamp
# Tests start hundreds of processes: without its cache, each would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE
ifneq ($(OS),Windows_NT)
export PATH := $(CURDIR)/.cache/toolchain/bin:$(PATH)
endif

.PHONY: build run test test-python test-rust test-again test-slow compiled explore fuzz proof torture lint audit no-std format bench docs site \
  pictures dist dist-check lock clean deb container release-check
.DELETE_ON_ERROR:

build: .venv/core.stamp

run: .venv/core.stamp
	@exec $(BIN)/python tools/tour.py

# The same cases in every run, but for those of tests/slow.txt. Both parts mostly wait: they run side by side.
test: .venv/core.stamp .venv/dev.stamp
	@$(MAKE) --no-print-directory -j 2 test-rust test-python

PYTEST := $(BIN)/pytest -n 6 --dist worksteal
test-python: .venv/core.stamp .venv/dev.stamp
	$(PYTEST) --slow without

# The Python cases that failed in the last run, or all of them if none did, and all Rust cases.
test-again: .venv/core.stamp .venv/dev.stamp test-rust
	$(PYTEST) --slow without --last-failed

# What the Rust tests print is kept, and shown if one fails.
RUST_LOG := .cache/test-rust.log
test-rust: $(TOOLCHAIN)
	@cargo test --locked --quiet $(CRATES) --lib --tests > $(RUST_LOG) 2>&1 && \
	  cargo test --locked --quiet $(CRATES) --doc >> $(RUST_LOG) 2>&1 && \
	  cargo test --locked --quiet --manifest-path $(FUZZ) --target-dir target --tests >> $(RUST_LOG) 2>&1 || \
	  { cat $(RUST_LOG); exit 1; }
	@awk '/^test result/ {passed += $$4} END {print "Rust: " passed " passed"}' $(RUST_LOG)

# The cases of tests/slow.txt, and the tests of the protocol crate once more, without its default features. With
# RERUN=--last-failed, of the Python cases only those that failed in the last run. Three workers, because half of
# them drive browsers: six would take longer, and wait for each other until a case gives up.
test-slow: .venv/core.stamp .venv/dev.stamp
	cargo test --locked --quiet -p holdfast-journal --test torture
	cargo test --locked --quiet $(PROTOCOL) --no-default-features
	$(BIN)/pytest -n 3 --dist worksteal --slow only $(RERUN)

# New cases for all property tests, and more of them. A case that fails is printed and kept: as a patch of the
# Python test (`git apply`), and for Rust as a line of a proptest-regressions file. Commit it with the mend. Each check
# of fuzz/src gets random inputs for SECONDS.
explore: export PROPTEST_RNG_SEED := $(shell date +%s)
explore: .venv/core.stamp .venv/dev.stamp
	@echo PROPTEST_RNG_SEED=$$PROPTEST_RNG_SEED
	PROPTEST_CASES=5000 cargo test --locked --quiet $(CRATES) --lib --tests; rust=$$?; \
	cargo run --locked --quiet --release --manifest-path $(FUZZ) --target-dir target/fuzz --bin random -- \
	  $$PROPTEST_RNG_SEED $(SECONDS); random=$$?; \
	HOLDFAST_EXPLORE=1 $(BIN)/pytest -m hypothesis && exit $$(( rust || random ))

# Looks for faults of the program and of its tests for HOURS: planted faults, fuzzing, new cases, hostile devices,
# mutants. Writes .cache/proof/report.md. Changes files of the checkout meanwhile, and restores them.
CARGO_MUTANTS := 27.1.0
HOURS ?= 4
proof: .venv/core.stamp .venv/dev.stamp .cache/tools/cargo-mutants-$(CARGO_MUTANTS).stamp
	$(BIN)/python tools/proof.py $(HOURS)

# Looks for inputs that break a check of fuzz/src for SECONDS, and keeps those that reach new code in .cache/fuzz.
# One that fails is printed and kept in fuzz/artifacts. Commit it to fuzz/corpus with the mend. No sanitizer watches
# memory: the crates forbid unsafe code.
TARGET ?= request
SECONDS ?= 60
COVERED := -Cpasses=sancov-module $(foreach each,level=4 inline-8bit-counters pc-table trace-compares,\
  -Cllvm-args=-sanitizer-coverage-$(each))
fuzz: $(TOOLCHAIN)
	@[ -d fuzz/corpus/$(TARGET) ] || { echo "TARGET is $(TARGET), allowed:" $(notdir $(wildcard fuzz/corpus/*)); exit 1; }
	@mkdir -p .cache/fuzz/$(TARGET) fuzz/artifacts/$(TARGET)
	host=$$(rustc --print host-tuple) && RUSTFLAGS="$(COVERED)" cargo build --locked --quiet --release --manifest-path $(FUZZ) \
	  --target-dir target/fuzz --target $$host --features libfuzzer --bin $(TARGET) && \
	  target/fuzz/$$host/release/$(TARGET) .cache/fuzz/$(TARGET) fuzz/corpus/$(TARGET) -timeout=10 \
	  -artifact_prefix=fuzz/artifacts/$(TARGET)/ -max_total_time=$(SECONDS)

lint: no-std .venv/core.stamp .venv/dev.stamp
	cargo fmt --check
	cargo fmt --check --manifest-path $(NO_STD)
	cargo fmt --check --manifest-path $(PEERS)/rust/Cargo.toml
	cargo fmt --check --manifest-path $(FUZZ)
	cargo clippy --locked --quiet --manifest-path $(FUZZ) --target-dir target --lib --bins --tests -- -D warnings
	cargo clippy --locked --quiet --workspace --all-targets -- -D warnings
	cargo clippy --locked --quiet $(PROTOCOL) --all-targets -- -D warnings
	cargo clippy --locked --quiet $(PROTOCOL) --all-targets --no-default-features -- -D warnings
	RUSTDOCFLAGS='-D warnings' cargo doc --locked --quiet --no-deps $(PROTOCOL)
	RUSTDOCFLAGS='-D warnings -A rustdoc::private-intra-doc-links' cargo doc --locked --quiet --no-deps --workspace \
	  --document-private-items
	cargo publish --locked --quiet --dry-run --allow-dirty $(PROTOCOL)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/mypy --platform win32 --cache-dir .mypy_cache/windows python/holdfast
	@$(BIN)/lint-imports --no-logo --cache-dir .cache/imports > .cache/imports.log || { cat .cache/imports.log; exit 1; }
	$(BIN)/python -m mypy.stubtest holdfast._core

# Licences, origins and known vulnerabilities of all dependencies.
CARGO_DENY := 0.20.2
audit: .venv/core.stamp .venv/dev.stamp .venv/release.stamp .cache/tools/cargo-deny-$(CARGO_DENY).stamp
	PATH="$(CURDIR)/.cache/tools/bin:$$PATH" $(BIN)/python tools/dependencies.py

# What takes longest to compile, side by side: the last step of a release build uses one core.
compiled: .venv/core.stamp .cache/tools/cargo-deny-$(CARGO_DENY).stamp

# A tool of Rust and its version: cargo-NAME-VERSION. Optimizing it would take longer than what it does.
.cache/tools/cargo-%.stamp: $(TOOLCHAIN)
	CARGO_PROFILE_DEV_DEBUG=0 cargo install --debug --locked --quiet --root .cache/tools cargo-$(subst -,@,$*)
	@touch $@

# Links a program without the standard library with the protocol crate: for this machine, and for a
# microcontroller if its target is installed (`rustup target add thumbv7em-none-eabi`).
NO_STD_BUILD := cargo build --locked --quiet --manifest-path $(NO_STD) --target-dir target/no_std
no-std:
	$(NO_STD_BUILD)
	$(NO_STD_BUILD) --features alloc
	@if [ -d "$$(rustc --print target-libdir --target $(BARE_METAL))" ]; then set -x; \
	  $(NO_STD_BUILD) --target $(BARE_METAL) && \
	  $(NO_STD_BUILD) --target $(BARE_METAL) --features alloc; \
	else echo "$(BARE_METAL) is not installed: built for this machine only"; fi

format: .venv/dev.stamp
	$(BIN)/python tools/sync_operations.py
	cargo fmt
	cargo fmt --manifest-path $(NO_STD)
	cargo fmt --manifest-path $(PEERS)/rust/Cargo.toml
	cargo fmt --manifest-path $(FUZZ)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# NAME is a benchmark of benches/, BENCH its options.
NAME ?= server
# Long runs of tests that `make test` does in short.
torture: .venv/core.stamp .venv/dev.stamp
	HOLDFAST_TORTURE=1 cargo test --locked --release --quiet -p holdfast-engine --test route
	HOLDFAST_TORTURE=1 cargo test --locked --release --quiet -p holdfast-journal -- --test-threads 1
	HOLDFAST_TORTURE=1 $(BIN)/pytest tests/server/test_slow_connections.py tests/outputs/test_mqtt_outage.py \
	  tests/fleet/test_moves.py tests/fleet/test_faults.py tests/hostile tests/oracle/test_running_appliance.py

bench: .venv/core.stamp .venv/dev.stamp
	cargo build --locked --quiet --release -p holdfast-benches
	$(BIN)/python benches/$(NAME).py $(BENCH)

# Writes what is made from the program: the schema of the configuration.
docs: .venv/core.stamp
	$(BIN)/holdfast check --schema > docs/config.schema.json
	$(BIN)/holdfast scan --schema > docs/scanner.schema.json

# Builds the documentation site in site/: its first page is site/index.html. A broken link is an error.
site: .venv/core.stamp .venv/docs.stamp
	rm -rf site
	$(BIN)/python -m sphinx --quiet --fail-on-warning --fresh-env --doctree-dir .cache/site docs site

# Takes the pictures of docs/images from the running console, with Chromium.
pictures: .venv/core.stamp .venv/dev.stamp
	cd tests && ../$(BIN)/python -m support.gateway_pictures $(PICTURES)

# Builds what this machine can into dist: the source distribution, and wheels. SYSTEMS names some only.
dist: .venv/run.stamp $(TOOLCHAIN)
	$(BIN)/python tools/dist.py $(SYSTEMS)

# Checks what is in dist, and installs and tries the wheel for this machine.
dist-check: .venv/core.stamp .venv/dev.stamp
	HOLDFAST_DIST=dist $(BIN)/pytest tests/packaging tests/docs/test_fresh_clone.py

# The Debian packages of the wheels in dist (docs/service.md). Needs debhelper.
deb: .venv/dev.stamp
	$(BIN)/python packaging/deb/build.py dist

IMAGE := localhost/holdfast-modbus
# The container image of the wheel in dist (docs/containers.md). Only the format of docker has health checks.
CONTAINER ?= $(firstword $(foreach tool,podman docker,$(shell command -v $(tool))) podman)
container:
	@ls dist/holdfast_modbus-$(VERSION)-*manylinux*.whl > /dev/null 2>&1 || \
	  { echo "dist has no wheel of Holdfast $(VERSION) for Linux with glibc: make dist"; exit 1; }
	$(CONTAINER) build $(if $(findstring podman,$(CONTAINER)),--format docker) \
	  --tag $(IMAGE):$(VERSION) --tag $(IMAGE):latest --file packaging/container/Containerfile .

# What can be checked before a release (docs/releasing.md), and the packages that it has. TAG is its tag.
release-check: .venv/release.stamp deb
	$(BIN)/python packaging/release/check.py dist $(TAG)

.venv/release.stamp: requirements/release.lock .venv/run.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r $<
	@touch $@

# Pins the newest versions that requirements/*.in allow.
lock: .venv/dev.stamp
	for set in run dev docs release rust zig; do $(BIN)/uv pip compile --quiet --upgrade --universal \
	  --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --no-annotate \
	  --output-file requirements/$$set.lock requirements/$$set.in; done
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-header --no-annotate --extra certs --extra mqtt --extra nats --extra sparkplug --extra windows \
	  --constraint requirements/dev.lock \
	  --output-file requirements/appliance.lock pyproject.toml
	cargo update
	cargo update --manifest-path $(NO_STD)
	cargo update --manifest-path $(PEERS)/rust/Cargo.toml
	cargo update --manifest-path $(FUZZ)
	cd $(PEERS)/node && npm install --package-lock-only --ignore-scripts
	cd $(PEERS)/go && go mod tidy
	cd crates/journal/tests/checker && go get -u ./... && go mod tidy

clean:
	rm -rf .venv .cache target build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	rm -f python/holdfast/_core.*.so

.venv/run.stamp: requirements/run.lock
	@$(PYTHON) tools/prepare.py environment
	@touch $@

.venv/dev.stamp: requirements/dev.lock .venv/run.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r $<
	@touch $@

.venv/docs.stamp: requirements/docs.lock .venv/run.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r $<
	@touch $@

$(TOOLCHAIN): tools/prepare.py requirements/rust.lock requirements/zig.lock .venv/run.stamp
	@$(BIN)/python tools/prepare.py toolchain
	@touch $@

.venv/core.stamp: $(RUST) pyproject.toml .venv/run.stamp $(TOOLCHAIN)
	@echo "Compiling the native core, which takes minutes in a fresh clone" >&2
	@PIP_QUIET=1 $(BIN)/python -m maturin develop --release --locked --quiet
	@touch $@
