#!/usr/bin/env bash
# Runs cargo-deny over Cargo.lock with deny.toml.
#   deny.sh            licences, bans and sources, which need only crates.io; and the lock files of the other workspaces
#   deny.sh advisories known vulnerabilities, whose database is fetched from the web
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

cargo_tool cargo-deny 0.20.2 --no-default-features

case ${1:-} in
advisories) "$tool" --locked check advisories ;;
"")
    # Duplicates are warnings. `cargo tree -d` shows their trees, which are long.
    "$tool" --locked check --hide-inclusion-graph bans licenses sources
    # Nothing that CI builds reads these.
    for workspace in bench bench/iroh-peer bench/zenoh-bridge fuzz tests/peers/hiroz; do
        cargo update --quiet --workspace --locked --manifest-path "$workspace/Cargo.toml" ||
            die "$workspace/Cargo.lock is out of date: cargo update --workspace --manifest-path $workspace/Cargo.toml"
    done
    say "advisories: NOT checked, because their database is not on crates.io; \`make advisories\` fetches it and checks them"
    ;;
*) die "usage: deny.sh [advisories]" ;;
esac
