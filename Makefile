# The two commands: `make demo` and `make test`. The rest are their parts.
# ARGS goes to `sgc demo` (or to the tests, in `make unit`): make demo ARGS="--seconds 10 --json"

CARGO ?= cargo
ARGS ?=

.PHONY: help demo test build deps-build deps-test peers vectors fmt clippy lint unit docs deny advisories peers-check peers-check-long ring model-check bench-routing scale clean-tools

help:
	@echo 'make demo        install what the build needs, build, run the demo (ARGS="--seconds 10 --json")'
	@echo 'make test        the whole suite, as CI runs it'
	@echo 'its parts:       lint (fmt, clippy), peers, vectors, peers-check, unit (ARGS goes to cargo test), docs, deny'
	@echo 'not in it:       peers-check-long (images of 13 MB), advisories (needs the web), clean-tools,'
	@echo '                 ring (two minutes of faults; SGC_RING_SEED, SGC_RING_SECONDS, SGC_RING_DIR keeps the logs)'
	@echo '                 model-check (larger bounds)'
	@echo '                 bench-routing (what routing costs, beside a TCP relay and zenoh: bench/README.md; ARGS="--quick")'
	@echo '                 scale (up to a thousand routers, simulated; some minutes)'

demo: build
	./target/release/sgc demo $(ARGS)

build: deps-build
	$(CARGO) build --release --locked -p sgc

# One after the other, the quick ones first, whatever -j says.
test: deps-test
	$(MAKE) fmt
	$(MAKE) deny
	$(MAKE) peers
	$(MAKE) vectors
	$(MAKE) clippy
	$(MAKE) peers-check
	$(MAKE) unit
	$(MAKE) docs

deps-build:
	@scripts/install-deps.sh build

deps-test:
	@scripts/install-deps.sh test

peers:
	@scripts/build-peers.sh

# The golden vectors of names, identities, tokens, sealing and grants, against an implementation that is not ours.
vectors: peers
	.venv/bin/python -B scripts/check-vectors.py
	.venv/bin/python -B scripts/trust-vectors.py

lint: fmt clippy

fmt:
	$(CARGO) fmt --all --check

clippy:
	$(CARGO) clippy --workspace --all-targets --locked -- -D warnings

# Includes the tests against the peers, so they must have been built.
unit: peers
	$(CARGO) test --workspace --locked $(ARGS)

docs:
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --no-deps --workspace --locked

deny:
	@scripts/deny.sh

advisories:
	@scripts/deny.sh advisories

# The peers against each other, with no sgc between them.
peers-check: peers
	.venv/bin/python -B tests/peers/check.py

peers-check-long: peers
	.venv/bin/python -B tests/peers/check.py --long

# Five routers that are cut and killed at random; a new seed each time, which it prints. The suite runs a short one.
ring: peers
	SGC_RING_SEED=$${SGC_RING_SEED:-$$(date +%s)} SGC_RING_SECONDS=$${SGC_RING_SECONDS:-120} \
		$(CARGO) test -p sgc --locked --test ring $(ARGS) -- --nocapture

# The tree protocol within larger bounds than in `unit`: minutes, and some GB.
model-check:
	CARGO_PROFILE_DEV_OPT_LEVEL=3 $(CARGO) test --locked -p sgc-testkit --test tree_protocol -- --ignored --nocapture

# A workspace of its own, since zenoh is large: no part of `make test`.
bench-routing: build
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml -- all \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# How the control protocol grows, in simulation; the tables of docs/performance.md. The suite runs ten routers of it.
scale:
	$(CARGO) run --release --locked -p sgc-testkit --example scale -- $(ARGS)

clean-tools:
	rm -rf .venv .tools .peers
