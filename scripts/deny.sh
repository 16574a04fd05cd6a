#!/usr/bin/env bash
# Runs cargo-deny over Cargo.lock with deny.toml.
#   deny.sh            licences, bans and sources, which need only crates.io
#   deny.sh advisories known vulnerabilities, whose database is fetched from the web
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

version=0.20.2
tool=.tools/bin/cargo-deny
if [ "$("$tool" --version 2>/dev/null)" != "cargo-deny $version" ]; then
    if [ "$(cargo-deny --version 2>/dev/null)" = "cargo-deny $version" ]; then
        tool=cargo-deny
    else
        # Unoptimised, because cargo-deny runs for a second or two and only its build takes long.
        say "building cargo-deny $version into .tools (about a minute, once)"
        CARGO_PROFILE_RELEASE_OPT_LEVEL=0 CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_DEBUG=0 \
            CARGO_TARGET_DIR=.tools/target cargo install --quiet --locked --root .tools --no-default-features \
            --version "$version" cargo-deny
        rm -rf .tools/target
    fi
fi

case ${1:-} in
advisories) "$tool" --locked check advisories ;;
"")
    # Duplicates are warnings. `cargo tree -d` shows their trees, which are long.
    "$tool" --locked check --hide-inclusion-graph bans licenses sources
    say "advisories: NOT checked, because their database is not on crates.io; \`make advisories\` fetches it and checks them"
    ;;
*) die "usage: deny.sh [advisories]" ;;
esac
