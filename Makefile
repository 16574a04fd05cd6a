# The main targets are `make demo` and `make test`. The others are their parts, or longer tests and benchmarks (`make help`).
# ARGS goes to the program of a target, such as `sgc demo` or `cargo test`: make demo ARGS="--duration 10s --json"

CARGO ?= cargo
ARGS ?=
# The features of release builds. Tests use them too, so that Cyclone DDS is built once.
FEATURES := --features sgc/sros2,sgc/zenoh
# Suites of tests with programs of others (`test = false` in their Cargo.toml): those with labs, and the rest. A suite may have
# other tests, too; then those with programs of others are ignored. A name stands for the suites of all crates, so no suite of
# `unit` may have one of these names: it would run twice.
LABS := $(addprefix --test ,fidelity gateway peers ros2 zenoh)
INTEROP := $(addprefix --test ,browser dashboard gateway_soak looking mended redis ring ros_graph soak transports vendors)
CLIENTS := $(addprefix --test ,foxglove grpc otlp rosbridge)

# Release builds name their commit (`sgc --version`), as far as the environment or the repository knows it.
COMMIT = SGC_COMMIT=$${SGC_COMMIT-$$(git describe --always --dirty --abbrev=8 --exclude '*' 2>/dev/null)} \
	SGC_COMMIT_DATE=$${SGC_COMMIT_DATE-$$(git log -1 --format=%cs 2>/dev/null)}

.PHONY: help demo test build dist dist-test new-user upgrade-test image image-test helm-lint ros-package deps-dist deps-build deps-test peers peers-hiroz vectors fmt clippy lint unit interop msrv print-msrv minimal docs book deny advisories peers-check peers-check-long ring churn dead-man zenoh-long stall fuzz soak gateway-soak bench-graph transports vendors model-check bench bench-routing bench-teleop bench-transports bench-gateway bench-direct bench-zenoh bench-instructions bench-store bench-look-up scale bench-link-state clean-tools deps-bench bench-peers

help:
	@echo 'make demo        install the requirements of the build, build, and run the demo (ARGS="--duration 10s --json")'
	@echo 'make test        run the whole suite, as CI does'
	@echo 'make dist        build the Debian package and the archive of the program in target/dist'
	@echo 'its parts:       lint (fmt, clippy), peers, vectors, peers-check, unit and interop (ARGS goes to cargo test), helm-lint,'
	@echo '                 ros-package, docs, deny'
	@echo 'not in it:       msrv (check with the oldest supported Rust), minimal (check without optional features, and with each alone)'
	@echo '                 dist-test (the package on a small Debian with systemd; root)'
	@echo '                 new-user (the commands and seconds from the package to the first topic; root)'
	@echo '                 upgrade-test (this version together with an earlier one, SGC_OLD; root)'
	@echo '                 image, image-test (the image of a container, with podman; root)'
	@echo '                 book (the documents as a book, target/book/index.html; builds mdbook once)'
	@echo '                 peers-hiroz (a further peer of Zenoh networks for peers-check; minutes, the first time)'
	@echo '                 peers-check-long (images of 13 MB), advisories (needs the web), clean-tools'
	@echo '                 ring (two minutes of faults, without and with a store; SGC_RING_SEED, SGC_RING_SECONDS; SGC_RING_DIR keeps the logs)'
	@echo '                 churn (200 random restarts; SGC_CHURN_SEED, SGC_CHURN_STEPS)'
	@echo '                 dead-man (500 trials of a robot that has to stop; SGC_DEAD_MAN_TRIALS, SGC_DEAD_MAN_SEED)'
	@echo '                 zenoh-long (100 restarts on networks of rmw_zenoh, and 10000 topics; SGC_ZENOH_RESTARTS, SGC_ZENOH_TOKENS)'
	@echo '                 stall (ten minutes of images to a stalled subscriber; SGC_STALL_SECONDS)'
	@echo '                 soak (20 nodes for two hours; SGC_SOAK_SECONDS, SGC_SOAK_SEED; SGC_SOAK_DIR keeps logs and samples; root)'
	@echo '                 gateway-soak (500 clients of the gateway, and 20000 short connections; SGC_SOAK_CLIENTS, SGC_SOAK_CONNECTS)'
	@echo '                 bench-graph (200 nodes, 2000 endpoints; SGC_GRAPH_NODES, SGC_GRAPH_SHARED, SGC_GRAPH_SECONDS)'
	@echo '                 transports (NATs, roaming and bad paths for each transport; minutes)'
	@echo '                 vendors (every pair of DDS vendors, every type with every QoS; minutes)'
	@echo '                 model-check (the tree protocol within larger bounds)'
	@echo '                 fuzz (each target for SGC_FUZZ_SECONDS; needs a nightly compiler and cargo-fuzz; ARGS="control certs")'
	@echo '                 scale (up to a thousand simulated routers; some minutes)'
	@echo 'benchmarks:      bench/README.md describes them'
	@echo '                 bench (SGC beside its alternatives; root, about an hour; ARGS="--quick" takes minutes)'
	@echo '                 bench-routing (the cost of routing, beside a TCP relay and zenoh; ARGS="--quick")'
	@echo '                 bench-teleop, bench-transports (every transport over emulated paths; root)'
	@echo '                 bench-gateway (gRPC and the rosbridge protocol)'
	@echo '                 bench-direct (direct paths between two NATs, beside WireGuard and iroh; root, half an hour)'
	@echo '                 bench-zenoh (programs of rmw_zenoh, natively and through SGC; root, eight minutes; ARGS="--quick")'
	@echo '                 bench-store (names in a cluster of redis-server; root, a minute; ARGS="--names 10000000")'
	@echo '                 bench-look-up (the first look-up of a name by flood, query and store; root)'
	@echo '                 bench-link-state (one router among up to 10 000)'
	@echo '                 bench-instructions (whether hot functions take more instructions than before; ARGS=--accept)'
	@echo '                 bench-peers (build the systems that bench runs beside SGC)'

demo: build
	"$${CARGO_TARGET_DIR:-target}/release/sgc" demo $(ARGS)

build: deps-build
	$(COMMIT) $(CARGO) build --release --locked -p sgc $(FEATURES)

# Packages, with their licences and checksums, in target/dist.
dist: deps-dist
	$(COMMIT) $(CARGO) build --release --locked -p sgc $(FEATURES)
	scripts/dist.sh "$${CARGO_TARGET_DIR:-target}/release/sgc"

# Installs, runs, upgrades, removes and purges the package on a small Debian whose systemd is started in a container. Root.
dist-test: dist
	scripts/dist-test.sh

# Plays a new user on a small Debian: from the package to the first topic and the dashboard. Root.
new-user: dist
	scripts/dist-test.sh new-user

# Runs an earlier version and this one together, in every role, between programs of ROS 2. Root.
upgrade-test: peers
	scripts/upgrade-test.sh

# The image of sgc, in podman's store of images.
image: dist
	@scripts/install-deps.sh image
	scripts/image.sh

# Builds the image on a small Debian, and runs router, robot and desk in containers. Root.
image-test: dist
	@scripts/install-deps.sh image
	scripts/image-test.sh

# Checks the Helm chart with the program of the tests, which is built if it is missing.
helm-lint:
	@[ -x "$${CARGO_TARGET_DIR:-target}/debug/sgc" ] || $(CARGO) build --locked -p sgc $(FEATURES)
	scripts/helm-lint.sh "$${CARGO_TARGET_DIR:-target}/debug/sgc"

# Builds the ROS package and starts a node as its launch file says, with the same program.
ros-package:
	@[ -x "$${CARGO_TARGET_DIR:-target}/debug/sgc" ] || $(CARGO) build --locked -p sgc $(FEATURES)
	scripts/ros-package.sh "$${CARGO_TARGET_DIR:-target}/debug/sgc"

# In sequence even with -j, the quick ones first. Each says how long it took.
test: deps-test
	@set -e; for part in fmt deny peers clippy peers-check unit vectors interop helm-lint ros-package docs; do \
		begin=$$(date +%s); $(MAKE) $$part; echo "== $$part took $$(($$(date +%s) - begin)) s"; \
	done

deps-build:
	@scripts/install-deps.sh build

deps-test:
	@scripts/install-deps.sh test

deps-bench:
	@scripts/install-deps.sh bench

deps-dist:
	@scripts/install-deps.sh dist

peers:
	@scripts/build-peers.sh

# Builds a further Zenoh peer, which `peers-check` uses if it is there. Minutes, the first time.
peers-hiroz:
	@scripts/build-hiroz.sh

# Checks the golden vectors of names, identities, both kinds of tokens, sealing and grants, and CDR with independent implementations.
vectors: peers
	.venv/bin/python -B scripts/check-vectors.py
	.venv/bin/python -B scripts/trust-vectors.py
	.venv/bin/python -B scripts/access-vectors.py
	$(CARGO) build --workspace $(FEATURES) --locked --example decode
	SGC_CDR_DECODE="$${CARGO_TARGET_DIR:-target}/debug/examples/decode" .venv/bin/python -B scripts/cdr-vectors.py

lint: fmt clippy

fmt:
	$(CARGO) fmt --all --check

clippy:
	$(CARGO) clippy --workspace --all-targets $(FEATURES) --locked -- -D warnings
	$(CARGO) clippy --workspace $(LABS) $(INTEROP) $(FEATURES) --locked -- -D warnings

# Has only the requirements of the build. `cargo test` runs the same without SROS2.
unit:
	$(CARGO) test --workspace $(FEATURES) --locked $(ARGS)

# The tests with programs of others: ROS 2, other DDS vendors, clients of the gateway, Chromium. Tests with labs take turns
# (`tests/support/turn.rs`), so most of their threads wait.
interop: peers
	$(CARGO) test --workspace $(CLIENTS) $(FEATURES) --locked -- --ignored
	RUST_TEST_THREADS=8 $(CARGO) test --workspace $(LABS) $(FEATURES) --locked $(ARGS)
	$(CARGO) test --workspace $(INTEROP) $(FEATURES) --locked $(ARGS)

# The oldest Rust that Cargo.toml supports. rustup must have it.
MSRV = $(shell sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)

print-msrv:
	@echo $(MSRV)

msrv:
	$(CARGO) +$(MSRV) check --workspace $(FEATURES) --locked

# Checks the program without its optional features, and with each alone; ARGS goes to cargo.
minimal:
	@CARGO='$(CARGO)' scripts/minimal.sh $(ARGS)

# Examples take the dependencies of tests, so that `clippy` has checked all dependencies with the same features before. Without
# them, other features would have Cyclone DDS built once more.
docs:
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --no-deps --workspace --lib --bin netsim --examples $(FEATURES) --locked

# Builds the pages below docs/ as a book and checks its links.
book:
	@scripts/book.sh

deny:
	@scripts/deny.sh

advisories:
	@scripts/deny.sh advisories

# Tests the peers against each other, without sgc between them.
peers-check: peers
	.venv/bin/python -B tests/peers/check.py
	.venv/bin/python -B tests/peers/check_zenoh.py

peers-check-long: peers
	.venv/bin/python -B tests/peers/check.py --long
	.venv/bin/python -B tests/peers/check_zenoh.py --long

# Cuts the links of five routers and kills routers at random, and then, with a store of names, also servers of the store. Prints
# its seed, a new one each time. The suite runs a short one. With the store alone: ARGS=with_a_store.
ring: peers
	SGC_RING_SEED=$${SGC_RING_SEED:-$$(date +%s)} SGC_RING_SECONDS=$${SGC_RING_SECONDS:-120} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test ring $(ARGS) -- --nocapture

# Has a robot stop in five hundred random trials: cut cables, killed and frozen programs, clocks that are set. Prints the times.
# The suite runs three.
dead-man: peers
	SGC_DEAD_MAN_SEED=$${SGC_DEAD_MAN_SEED:-$$(date +%s)} SGC_DEAD_MAN_TRIALS=$${SGC_DEAD_MAN_TRIALS:-500} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test ros2 $(ARGS) -- in_random_trials --nocapture

# Restarts programs of rmw_zenoh a hundred times, and floods a network of theirs with ten thousand topics. The suite runs a short one.
zenoh-long: peers
	SGC_ZENOH_RESTARTS=$${SGC_ZENOH_RESTARTS:-100} SGC_ZENOH_TOKENS=$${SGC_ZENOH_TOKENS:-10000} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test zenoh $(ARGS) -- leave_neither hostile --nocapture

# Restarts programs and nodes two hundred times at random. Prints its seed, a new one each time. The suite runs a short one.
churn: peers
	SGC_CHURN_SEED=$${SGC_CHURN_SEED:-$$(date +%s)} SGC_CHURN_STEPS=$${SGC_CHURN_STEPS:-200} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test fidelity $(ARGS) nothing_is_left -- --nocapture

# Sends images to a stalled subscriber for ten minutes. The suite runs a short one.
stall: peers
	SGC_STALL_SECONDS=$${SGC_STALL_SECONDS:-600} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test fidelity $(ARGS) stands_still -- --nocapture

# Runs the fuzz targets for long and adds new inputs to fuzz/corpus. `unit` runs the targets over that folder.
fuzz:
	scripts/fuzz.sh $(ARGS)

# Runs twenty nodes with two hundred topics for two hours while nodes are killed and routers change, and fails if memory, file
# descriptors, threads, logs or metrics grow. SGC_SOAK_DIR keeps the logs and samples. Root. The suite runs a short one.
soak: peers
	SGC_SOAK_SEED=$${SGC_SOAK_SEED:-$$(date +%s)} SGC_SOAK_SECONDS=$${SGC_SOAK_SECONDS:-7200} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test soak $(ARGS) -- --nocapture

# Measures the memory of the gateway with a client that does not read, with 500 clients, and after 20000 short connections, as
# many as one every two minutes makes in four weeks. The suite runs a short one.
gateway-soak: peers
	SGC_SOAK_CLIENTS=$${SGC_SOAK_CLIENTS:-500} SGC_SOAK_CONNECTS=$${SGC_SOAK_CONNECTS:-20000} \
		$(CARGO) test -p sgc $(FEATURES) --locked --test gateway_soak $(ARGS) -- --nocapture

# Measures the cost of a network of 200 nodes and 2000 endpoints for a node that shares 50 of them.
bench-graph: peers
	SGC_GRAPH_NODES=$${SGC_GRAPH_NODES:-200} SGC_GRAPH_SHARED=$${SGC_GRAPH_SHARED:-50} SGC_GRAPH_SECONDS=$${SGC_GRAPH_SECONDS:-60} \
		$(CARGO) test --release -p sgc $(FEATURES) --locked --test fidelity $(ARGS) a_busy_network -- --nocapture

# Tests every transport through NATs, roaming and bad paths, one at a time and five times over; prints the cost of each.
transports: peers
	SGC_TRANSPORTS_LONG=1 $(CARGO) test -p sgc $(FEATURES) --locked --test transports $(ARGS) -- --nocapture

# Tests the whole matrix of DDS vendors, of which the suite runs a part. SGC_VENDORS=direct: without sgc in between.
vendors: peers
	SGC_VENDORS=$${SGC_VENDORS:-full} $(CARGO) test -p sgc $(FEATURES) --locked --test vendors $(ARGS) -- --nocapture

# Checks the tree protocol within larger bounds than `unit` does. It takes minutes and some GB.
model-check:
	CARGO_PROFILE_DEV_OPT_LEVEL=3 $(CARGO) test --locked -p sgc-testkit --test tree_protocol -- --ignored --nocapture

# The benchmarks without Zenoh, and the load generator on DDS.
BENCH_BUILD = $(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench -p sgc-bench-load \
	--no-default-features --features sgc-bench-load/dds
# The load generator as programs of rmw_zenoh.
ZENOH_LOAD = $(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench-load --no-default-features \
	--features zenoh --target-dir bench/target/zenoh

# Measures SGC and its alternatives side by side; root. The alternatives are built first, each where `compare` looks for it:
# ROS 2, the load generator with DDS Security and with Zenoh, and the Zenoh bridge as its own project builds it, which takes
# long.
bench: build
	@scripts/install-deps.sh bench
	@scripts/build-ros2.sh
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench-load --features dds-security \
		--target-dir bench/target/dds-security
	$(CARGO) build --release --locked --manifest-path bench/zenoh-bridge/Cargo.toml --target-dir bench/zenoh-bridge/target
	$(ZENOH_LOAD)
	$(BENCH_BUILD)
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- compare \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# A separate workspace outside of `make test`, because zenoh is large.
bench-routing: build
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml -- all \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# These two need root, and neither zenoh nor the program. ARGS="--quick", ARGS="--schemes quic,dtls".
bench-teleop: deps-build
	$(CARGO) run --release --locked --no-default-features --manifest-path bench/Cargo.toml -- teleop $(ARGS)

bench-transports: deps-build
	$(CARGO) run --release --locked --no-default-features --manifest-path bench/Cargo.toml -- transports $(ARGS)

# Needs neither root nor zenoh. ARGS="--quick", ARGS="--ways rosbridge-json,grpc-cdr".
bench-gateway: build
	$(BENCH_BUILD)
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- gateway \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# Builds iroh first, which takes minutes. ARGS="--quick", ARGS="--systems sgc-direct,iroh-direct".
bench-direct: build
	@scripts/install-deps.sh bench
	$(CARGO) build --release --locked --manifest-path bench/iroh-peer/Cargo.toml --target-dir bench/iroh-peer/target
	$(BENCH_BUILD)
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- direct \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# Runs the tables of `compare` that have programs of rmw_zenoh. The report is in target/bench-zenoh, because bench/results has
# that of the whole comparison. ARGS="--quick", ARGS="--systems sgc-zenoh-zenoh".
bench-zenoh: build
	$(ZENOH_LOAD)
	$(BENCH_BUILD)
	$(CARGO) run --release --locked --manifest-path bench/Cargo.toml --no-default-features -p sgc-bench -- compare \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" --only rmw-zenoh,rmw-zenoh-idle --out target/bench-zenoh $(ARGS)

# Builds the peers of `compare`: the Zenoh bridge (minutes, the first time), the load generator with DDS Security and with
# Zenoh, and ROS 2.
bench-peers: deps-bench
	@scripts/build-ros2.sh
	$(CARGO) build --release --locked --manifest-path bench/zenoh-bridge/Cargo.toml --target-dir bench/zenoh-bridge/target
	$(CARGO) build --release --locked --manifest-path bench/Cargo.toml -p sgc-bench-load --features dds-security \
		--target-dir bench/target/dds-security
	$(ZENOH_LOAD)

# Compares with bench/instructions.json and fails if a count grew. ARGS=--accept writes the current counts there; ARGS=seal
# counts only the cases with "seal" in their names.
bench-instructions: deps-bench
	$(CARGO) bench --locked --manifest-path bench/Cargo.toml -p sgc-bench-instructions --bench hot -- $(ARGS)

# Simulates the growth of the control protocol and prints the tables of benchmarks/routing.md. The suite runs ten routers.
scale:
	$(CARGO) run --release --locked -p sgc-testkit --example scale -- $(ARGS)

# Fills a cluster of redis-server with names, looks them up, kills servers, and prints the table of benchmarks/store.md; root.
bench-store:
	$(CARGO) run --release --locked -p sgc-store --example names -- $(ARGS)

# Looks names up at routers' processes by the mappings flood, query and store, in one run; root.
bench-look-up: build
	$(CARGO) run --release --locked --no-default-features --manifest-path bench/Cargo.toml -- first-look-up \
		--sgc "$${CARGO_TARGET_DIR:-target}/release/sgc" $(ARGS)

# Measures one router among 100, 1000 and 10 000: searches for paths, and everything else that its link states cost.
bench-link-state:
	$(CARGO) run --release --locked -p sgc-testkit --example link_state -- $(ARGS)

clean-tools:
	rm -rf .venv .tools .peers
