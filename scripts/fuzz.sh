#!/usr/bin/env bash
# Runs fuzz targets one after the other, each for SGC_FUZZ_SECONDS (600), and adds new inputs to fuzz/corpus.
#   fuzz.sh            every target
#   fuzz.sh TARGET…    these targets
# Needs a nightly compiler (SGC_FUZZ_TOOLCHAIN, "nightly") and cargo-fuzz. The folder target/fuzz-corpus keeps found inputs
# from run to run. The corpus gets those that reach code that no committed input reaches, up to CORPUS_BYTES_MAX each.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

CORPUS_BYTES_MAX=4096
seconds=${SGC_FUZZ_SECONDS:-600}
toolchain=${SGC_FUZZ_TOOLCHAIN:-nightly}
cargo "+$toolchain" fuzz --version >/dev/null 2>&1 ||
    die "missing: rustup toolchain install $toolchain; cargo install cargo-fuzz"
targets=("$@")
if [ ${#targets[@]} = 0 ]; then
    mapfile -t targets < <(cargo "+$toolchain" fuzz list)
fi
for target in "${targets[@]}"; do
    say "fuzzing $target for $seconds s"
    found=target/fuzz-corpus/$target
    mkdir -p "$found" "fuzz/corpus/$target"
    cargo "+$toolchain" fuzz run -O "$target" "$found" "fuzz/corpus/$target" -- \
        -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 -print_final_stats=1
    # Without -reduce_inputs, committed inputs are never replaced.
    cargo "+$toolchain" fuzz run -O "$target" "fuzz/corpus/$target" "$found" -- \
        -merge=1 -max_len="$CORPUS_BYTES_MAX" -timeout=10
done
