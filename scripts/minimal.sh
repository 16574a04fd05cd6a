#!/usr/bin/env bash
# Checks the program without its optional features, and with each alone: no warnings, no dependencies of disabled features,
# and typed refusals of configurations that need them. Arguments go to cargo.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo=${CARGO:-cargo}

# The crates that only this feature needs.
declare -A crates=(
    [dtls]="dimpl"
    [grpc]="tonic prost"
    [otlp]="sgc-otlp prost"
    [zenoh]="sgc-zenoh-network zenoh zenoh-ext"
)

for feature in "" dtls foxglove grpc otlp rosbridge zenoh; do
    echo "features: ${feature:-none}"
    $cargo clippy -p sgc --no-default-features --features "$feature" --locked "$@" -- -D warnings
    tree=$($cargo tree -p sgc -e normal --no-default-features --features "$feature" --locked --prefix none --format '{p}' "$@")
    for other in "${!crates[@]}"; do
        for crate in ${crates[$other]}; do
            [[ " ${crates[${feature:-none}]:-} " == *" $crate "* ]] && continue
            if grep -q "^$crate v" <<<"$tree"; then
                echo "$crate is part of a build with the features: ${feature:-none}" >&2
                exit 1
            fi
        done
    done
done
$cargo test -p sgc-node --no-default-features --locked --test features "$@"
