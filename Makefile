# The two commands: `make demo` and `make test`. The rest are their parts.
# ARGS goes to `sgc demo` (or to the tests, in `make unit`): make demo ARGS="--seconds 10 --json"

CARGO ?= cargo
ARGS ?=
# What release builds have. Tests have it, too, so that Cyclone DDS is built once.
FEATURES := --features sgc/sros2
# Suites of tests with programs that are not ours (`test = false` in their Cargo.toml), and those with some such tests, which are ignored.
INTEROP := $(addprefix --test ,browser fidelity gateway gateway_soak graph looking peers ring ros2 transports vendors)
CLIENTS := $(addprefix --test ,foxglove grpc rosbridge)

.PHONY: help demo test build deps-build deps-test peers vectors fmt clippy lint unit docs book deny advisories peers-check peers-check-long ring churn stall fuzz gateway-soak bench-graph transports vendors model-check bench bench-routing bench-teleop bench-transports bench-gateway bench-instructions scale clean-tools deps-bench bench-peers

help:
	@echo 'make demo        install what the build needs, build, run the demo (ARGS="--seconds 10 --json")'
	@echo 'make test        the whole suite, as CI runs it'
	@echo 'its parts:       lint (fmt, clippy), peers, vectors, peers-check, unit and interop (ARGS goes to cargo test), docs, deny'
	@echo 'not in it:       msrv (checks with the oldest Rust that is supported), minimal (without optional features, and with each alone)'
	@echo '                 book (the documents as a book, target/book/index.html; builds mdbook once)'
	@echo '                 peers-check-long (images of 13 MB), advisories (needs the web), clean-tools,'
	@echo '                 ring (two minutes of faults; SGC_RING_SEED, SGC_RING_SECONDS, SGC_RING_DIR keeps the logs)'
	@echo '                 churn (200 restarts at random; SGC_CHURN_SEED, SGC_CHURN_STEPS), stall (ten minutes of images to who stands still)'
	@echo '                 gateway-soak (500 clients of the gateway, and 20000 that come and go; SGC_SOAK_CLIENTS, SGC_SOAK_CONNECTS)'
	@echo '                 bench-graph (200 nodes, 2000 endpoints; SGC_GRAPH_NODES, SGC_GRAPH_SHARED, SGC_GRAPH_SECONDS)'
	@echo '                 transports (NATs, roaming and bad paths for each transport; minutes)'
	@echo '                 vendors (each DDS vendor to each, every type with every QoS; minutes)'
	@echo '                 model-check (larger bounds)'
	@echo '                 bench (SGC beside what users would pick instead: bench/README.md; root, about an hour; ARGS="--quick" is minutes)'
	@echo '                 bench-routing (what routing costs, beside a TCP relay and zenoh: bench/README.md; ARGS="--quick")'
	@echo '                 bench-teleop, bench-transports (every transport over emulated paths; root)'
	@echo '                 bench-gateway (gRPC and the rosbridge protocol: bench/README.md)'
	@echo '                 bench-instructions (whether hot functions take more instructions than before: bench/README.md; ARGS=--accept)'
	@echo '                 fuzz (each target for SGC_FUZZ_SECONDS, with a nightly compiler and cargo-fuzz; ARGS="control certs")'
	@echo '                 scale (up to a thousand routers, simulated; some minutes)'

demo: build
	"$${CARGO_TARGET_DIR:-target}/release/sgc" demo $(ARGS)

build: deps-build
	$(CARGO) build --release --locked -p sgc $(FEATURES)

# One after the other, the quick ones first, whatever -j says.
test: deps-test
	$(MAKE) fmt
	$(MAKE) deny
	$(MAKE) peers
	$(MAKE) vectors
	$(MAKE) clippy
	$(MAKE) peers-check
	$(MAKE) unit
	$(MAKE) interop
	$(MAKE) docs

deps-build:
	@scripts/install-deps.sh build

deps-test:
	@scripts/install-deps.sh test

deps-bench:
	@scripts/install-deps.sh bench

peers:
	@scripts/build-peers.sh

# The golden vectors of names, identities, tokens of both kinds, sealing and grants, and CDR, against implementations that are not ours.
vectors: peers
	.venv/bin/python -B scripts/check-vectors.py
	.venv/bin/python -B scripts/trust-vectors.py
	.venv/bin/python -B scripts/access-vectors.py
	.venv/bin/python -B scripts/cdr-vectors.py

lint: fmt clippy

fmt:
	$(CARGO) fmt --all --check

clippy:
	$(CARGO) clippy --workspace --all-targets $(FEATURES) --locked -- -D warnings
	$(CARGO) clippy --workspace $(INTEROP) $(FEATURES) --locked -- -D warnings

# Needs nothing but what the build needs. `cargo test` runs the same without SROS2.
unit:
	$(CARGO) test --workspace $(FEATURES) --locked $(ARGS)

# The tests with programs that are not ours: ROS 2, other DDS vendors, clients of the gateway, Chromium.
interop: peers
	$(CARGO) test --workspace $(CLIENTS) $(FEATURES) --locked -- --ignored
	$(CARGO) test --workspace $(INTEROP) $(FEATURES) --locked $(ARGS)

# The oldest Rust that Cargo.toml promises, which rustup must have.
MSRV = $(shell sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)

print-msrv:
	@echo $(MSRV)

msrv:
	$(CARGO) +$(MSRV) check --workspace $(FEATURES) --locked

# The program without its optional features, and with each alone; ARGS goes to cargo.
minimal:
	@CARGO='$(CARGO)' scripts/minimal.sh $(ARGS)

docs:
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --no-deps --workspace $(FEATURES) --locked

# The pages below docs/ as a book, with its links checked.
book:
	@scripts/book.sh

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
		$(CARGO) test -p sgc $(FEATURES) --locked --test ring $(ARGS) -- --nocapture

# Two hundred restarts of programs and nodes at random; a new seed each time, which it prints. The suite runs a short one.
churn: peers
	SGC_CHURN_SEED=$${SGC_CHURN_SEED:-$$(date +%s)} SGC_CHURN_STEPS=$${SGC_CHURN_STEPS:-200} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test fidelity $(ARGS) nothing_is_left -- --nocapture

# Ten minutes of images to a subscriber that stands still. The suite runs a short one.
stall: peers
	SGC_STALL_SECONDS=$${SGC_STALL_SECONDS:-600} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test fidelity $(ARGS) stands_still -- --nocapture

# Long searches of the fuzz targets; adds what they find to fuzz/corpus. `unit` runs the targets over that folder.
fuzz:
	scripts/fuzz.sh $(ARGS)

# What the gateway holds with 500 clients, one that does not read, and as many that come and go as one every two minutes makes in
# 26 days. The suite runs a short one.
gateway-soak: peers
	SGC_SOAK_CLIENTS=$${SGC_SOAK_CLIENTS:-500} SGC_SOAK_CONNECTS=$${SGC_SOAK_CONNECTS:-20000} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test gateway_soak $(ARGS) -- --nocapture

# What a network of 200 nodes and 2000 endpoints costs a node, 50 of them shared.
bench-graph: peers
	SGC_GRAPH_NODES=$${SGC_GRAPH_NODES:-200} SGC_GRAPH_SHARED=$${SGC_GRAPH_SHARED:-50} SGC_GRAPH_SECONDS=$${SGC_GRAPH_SECONDS:-60} \
		$(CARGO) test --release -p sgc $(FEATURES) --locked --test fidelity $(ARGS) a_busy_network -- --nocapture

# Every transport through NATs, roaming and bad paths, one at a time and five times over; prints what each cost.
transports: peers
	SGC_TRANSPORTS_LONG=1 $(CARGO) test -p sgc $(FEATURES) --locked --test transports $(ARGS) -- --nocapture

# The whole matrix of DDS vendors, of which the suite runs a part. SGC_VENDORS=direct: with no sgc in between.
vendors: peers
	SGC_VENDORS=$${SGC_VENDORS:-full} $(CARGO) test -p sgc $(FEATURES) --locked --test vendors $(ARGS) -- --nocapture

# The tree protocol within larger bounds than in `unit`: minutes, and some GB.
model-check:
	CARGO_PROFILE_DEV_OPT_LEVEL=3 $(CARGO) test --locked -p sgc-testkit --test tree_protocol -- --ignored --nocapture

# SGC and what users would pick instead, side by side; root. What SGC is measured beside is built first, each where `compare`
# looks for it: ROS 2, the load generator with DDS Security, and the Zenoh bridge as its own project builds it, which takes long.
bench: build
	@scripts/install-deps.sh bench
	@scripts/build-ros2.sh
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench-load --features dds-security \
		--target-dir bench/target/dds-security
	$(CARGO) build --release --locked --manifest-path bench/zenoh-bridge/Cargo.toml --target-dir bench/zenoh-bridge/target
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -p sgc-bench-load
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- compare \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# A workspace of its own, since zenoh is large: no part of `make test`.
bench-routing: build
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml -- all \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# Need root, and neither zenoh nor the program. ARGS="--quick", ARGS="--schemes quic,dtls".
bench-teleop: deps-build
	$(CARGO) run --release --locked --no-default-features --manifest-path bench/Cargo.toml -- teleop $(ARGS)

bench-transports: deps-build
	$(CARGO) run --release --locked --no-default-features --manifest-path bench/Cargo.toml -- transports $(ARGS)

# Needs neither root nor zenoh. ARGS="--quick", ARGS="--ways rosbridge-json,grpc-cdr".
bench-gateway: build
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -p sgc-bench-load
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- gateway \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# What `compare` runs beside `sgc`: the Zenoh bridge (minutes, the first time), talkers with DDS Security, and ROS 2.
bench-peers: deps-bench
	@scripts/build-ros2.sh
	$(CARGO) build --release --locked --manifest-path bench/zenoh-bridge/Cargo.toml --target-dir bench/zenoh-bridge/target
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench-load --features dds-security \
		--target-dir bench/target/dds-security

# Compares with bench/instructions.json and fails if something grew. ARGS=--accept takes what is for what is right, ARGS=seal
# counts those with that in their names.
bench-instructions: deps-bench
	$(CARGO) bench --locked --manifest-path bench/Cargo.toml -p sgc-bench-instructions --bench hot -- $(ARGS)

# How the control protocol grows, in simulation; the tables of benchmarks/routing.md. The suite runs ten routers of it.
scale:
	$(CARGO) run --release --locked -p sgc-testkit --example scale -- $(ARGS)

clean-tools:
	rm -rf .venv .tools .peers
