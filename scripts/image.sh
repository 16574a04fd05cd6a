#!/usr/bin/env bash
# Builds the image of sgc with podman, from the program of `make dist`.
#   image.sh [NAME]      sgc
#   SGC_IMAGE_BASE       the image below it (Debian's small one)
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

name=${1:-sgc}
stage=target/dist/stage
context=target/dist/image
[ -x $stage/bin/sgc ] || die "no program in target/dist: make dist"
rm -rf $context
install -D -t $context/files/bin $stage/bin/sgc
install -D -m 644 -t $context/files/share/doc/sgc $stage/share/doc/{LICENSE,NOTICE,licences.txt}
base=(${SGC_IMAGE_BASE:+--build-arg "DEBIAN=$SGC_IMAGE_BASE"})
# The format of Docker has health checks.
podman build --quiet --format docker --build-context "files=$context" "${base[@]}" -f dist/container/Dockerfile -t "$name" $context
rm -rf $context
