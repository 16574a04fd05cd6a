#!/usr/bin/env bash
# Builds the independent test peers .peers/cyclone and .peers/zenoh (Python), .peers/fastdds (C++) and .peers/rustdds (Rust).
# Installs ROS 2 (build-ros2.sh), Prometheus (get-prometheus.sh), and the Python and JavaScript libraries that clients of the
# gateway use.
# Skips each part that is newer than its sources.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

mkdir -p .peers
requirements=tests/peers/py/requirements.txt
installed=.venv/installed.txt
if ! cmp -s "$requirements" "$installed"; then
    # `--clear` would empty the target of a link, which belongs to another checkout.
    if [ -L .venv ]; then
        rm .venv
    fi
    say "Python environment in .venv: $(grep -m1 '^cyclonedds' "$requirements")"
    python3 -m venv --clear .venv
    .venv/bin/pip install --quiet --disable-pip-version-check --only-binary :all: -r "$requirements"
    cp "$requirements" "$installed"
fi

# The tests of roslibpy itself, in the installed version.
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

# The lock file pins dependencies by hash, and no scripts run during the installation.
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

cat >.peers/zenoh <<'SCRIPT'
#!/bin/sh
here=$(cd "$(dirname "$0")/.." && pwd)
exec "$here/.venv/bin/python" -B "$here/tests/peers/zenoh/peer.py" "$@"
SCRIPT
chmod +x .peers/zenoh

source=tests/peers/fastdds/peer.cpp
if [ ! -x .peers/fastdds ] || [ -n "$(find tests/peers/fastdds -newer .peers/fastdds -type f)" ]; then
    say "Fast DDS peer"
    "${CXX:-g++}" -std=c++17 -O2 -Wall -Wextra -Werror -o .peers/fastdds.new "$source" -lfastrtps -lfastcdr -lpthread
    mv .peers/fastdds.new .peers/fastdds
fi

scripts/build-ros2.sh
scripts/get-prometheus.sh

# A separate workspace with its own target directory, so its dependencies stay apart. Cargo skips an unchanged build.
say "RustDDS peer"
CARGO_TARGET_DIR=.peers/rustdds-target "${CARGO:-cargo}" build --quiet --release --locked --manifest-path tests/peers/rustdds/Cargo.toml
if ! cmp -s .peers/rustdds-target/release/rustdds-peer .peers/rustdds; then
    cp .peers/rustdds-target/release/rustdds-peer .peers/rustdds.new
    mv .peers/rustdds.new .peers/rustdds
fi
