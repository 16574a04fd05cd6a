#!/usr/bin/env bash
# Builds the test peer .peers/hiroz (Rust). Its 400 crates take minutes, so `make peers` leaves it out.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

mkdir -p .peers
# A separate workspace with its own target directory, as that of RustDDS. Cargo skips an unchanged build.
say "hiroz peer"
"${CARGO:-cargo}" build --quiet --release --locked --manifest-path tests/peers/hiroz/Cargo.toml --target-dir .peers/hiroz-target
if ! cmp -s .peers/hiroz-target/release/hiroz-peer .peers/hiroz; then
    cp .peers/hiroz-target/release/hiroz-peer .peers/hiroz.new
    mv .peers/hiroz.new .peers/hiroz
fi
