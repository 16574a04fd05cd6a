#!/usr/bin/env bash
# Builds the test peers that are not ours to test against: .peers/cyclone (Python), .peers/fastdds (C++) and .peers/rustdds (Rust),
# installs ROS 2 (build-ros2.sh) and the libraries that clients of the gateway use, of Python and JavaScript.
# Does nothing for what is there and newer than its sources.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

mkdir -p .peers
requirements=tests/peers/py/requirements.txt
installed=.venv/installed.txt
if ! cmp -s "$requirements" "$installed"; then
    # `--clear` would empty what a link leads to, which is another checkout's.
    if [ -L .venv ]; then
        rm .venv
    fi
    say "Python environment in .venv: $(grep -m1 '^cyclonedds' "$requirements")"
    python3 -m venv --clear .venv
    .venv/bin/pip install --quiet --disable-pip-version-check --only-binary :all: -r "$requirements"
    cp "$requirements" "$installed"
fi

# roslibpy's own tests, of the version that is installed.
source_of=tests/peers/py/roslibpy-source.txt
if ! cmp -s "$source_of" .peers/roslibpy/installed.txt; then
    say "roslibpy's own tests in .peers/roslibpy"
    rm -rf .peers/roslibpy .peers/roslibpy.new
    mkdir .peers/roslibpy.new
    .venv/bin/pip download --quiet --disable-pip-version-check --no-deps --no-binary :all: --no-build-isolation \
        --require-hashes -r "$source_of" -d .peers/roslibpy.new
    tar -xzf .peers/roslibpy.new/roslibpy-*.tar.gz -C .peers/roslibpy.new --strip-components 1
    cp "$source_of" .peers/roslibpy.new/installed.txt
    mv .peers/roslibpy.new .peers/roslibpy
fi

# What they depend on is pinned with its hashes, and runs nothing while it is installed.
lock=tests/js/package-lock.json
if ! cmp -s "$lock" tests/js/node_modules/installed.json; then
    say "JavaScript clients in tests/js"
    npm ci --prefix tests/js --ignore-scripts --no-audit --no-fund --loglevel error >/dev/null
    cp "$lock" tests/js/node_modules/installed.json
fi

cat >.peers/cyclone <<'SCRIPT'
#!/bin/sh
here=$(cd "$(dirname "$0")/.." && pwd)
exec "$here/.venv/bin/python" -B "$here/tests/peers/py/peer.py" "$@"
SCRIPT
chmod +x .peers/cyclone

source=tests/peers/fastdds/peer.cpp
if [ ! -x .peers/fastdds ] || [ -n "$(find tests/peers/fastdds -newer .peers/fastdds -type f)" ]; then
    say "Fast DDS peer"
    "${CXX:-g++}" -std=c++17 -O2 -Wall -Wextra -Werror -o .peers/fastdds.new "$source" -lfastrtps -lfastcdr -lpthread
    mv .peers/fastdds.new .peers/fastdds
fi

scripts/build-ros2.sh

# A workspace of its own, built where its dependencies are kept apart from ours. Cargo knows what is there and newer.
say "RustDDS peer"
CARGO_TARGET_DIR=.peers/rustdds-target "${CARGO:-cargo}" build --quiet --release --locked --manifest-path tests/peers/rustdds/Cargo.toml
if ! cmp -s .peers/rustdds-target/release/rustdds-peer .peers/rustdds; then
    cp .peers/rustdds-target/release/rustdds-peer .peers/rustdds.new
    mv .peers/rustdds.new .peers/rustdds
fi
