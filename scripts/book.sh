#!/usr/bin/env bash
# Builds the book of docs/ into target/book with mdbook, and checks its links.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

# Without its server.
cargo_tool mdbook 0.5.4 --no-default-features --features search

rm -rf target/book
"$tool" build
python3 -B scripts/book.py check target/book
say "the book is target/book/index.html"
