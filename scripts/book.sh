#!/usr/bin/env bash
# Builds the book of docs/ into target/book with mdbook, and checks its links.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

version=0.5.4
tool=.tools/bin/mdbook
if [ "$("$tool" --version 2>/dev/null)" != "mdbook v$version" ]; then
    if [ "$(mdbook --version 2>/dev/null)" = "mdbook v$version" ]; then
        tool=mdbook
    else
        # Unoptimised and without its server, because mdbook runs for a second or two and only its build takes long.
        say "building mdbook $version into .tools (a minute or two, once)"
        CARGO_PROFILE_RELEASE_OPT_LEVEL=0 CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_DEBUG=0 \
            CARGO_TARGET_DIR=.tools/target cargo install --quiet --locked --root .tools --no-default-features --features search \
            --version "$version" mdbook
        rm -rf .tools/target
    fi
fi

rm -rf target/book
"$tool" build
python3 -B scripts/book.py check target/book
say "the book is target/book/index.html"
