#!/usr/bin/env bash
# Runs fuzz targets one after the other, each for SGC_FUZZ_SECONDS (600), and adds what was found to fuzz/corpus.
#   fuzz.sh            every target
#   fuzz.sh TARGET…    these
# Needs a nightly compiler (SGC_FUZZ_TOOLCHAIN, "nightly") and cargo-fuzz. Inputs are found in target/fuzz-corpus, which is kept
# from run to run; of these the corpus gets the ones that reach code no committed input reaches, up to CORPUS_BYTES_MAX each.
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
    # Without -reduce_inputs nothing that is committed is replaced.
    cargo "+$toolchain" fuzz run -O "$target" "fuzz/corpus/$target" "$found" -- \
        -merge=1 -max_len="$CORPUS_BYTES_MAX" -timeout=10
done
