#!/usr/bin/env bash
# Builds what is published into target/dist: a Debian package, an archive for other systems, the licences of everything in the
# program, a bill of materials, and checksums.
#   dist.sh PROGRAM [TARGET]   PROGRAM is the release build, TARGET its Rust target (this machine's)
# docs/how-to/build.md says how to build for another processor.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

program=${1:?"usage: dist.sh PROGRAM [TARGET]"}
host=$(rustc -vV | sed -n 's/^host: //p')
target=${2:-$host}
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
out=target/dist
stage=$out/stage
name=sgc-$version-${target%%-*}-linux
rm -rf "$out"
mkdir -p "$stage/bin" "$stage/share/man/man1" "$stage/share/completions" "$stage/share/doc"

# The program that writes its pages has to run here, the one that is packed need not.
runs=$program
[ "$target" = "$host" ] || runs=${CARGO_TARGET_DIR:-target}/release/sgc
strip_with=strip
[ "$target" = "$host" ] || strip_with=${target%%-*}-linux-gnu-strip
"$strip_with" -o "$stage/bin/sgc" "$program"
"$runs" man "$stage/share/man/man1"
gzip -9n "$stage"/share/man/man1/*
for shell in bash zsh fish; do
    "$runs" completions "$shell" >"$stage/share/completions/$shell"
done

# It compares every file with every licence.
TOOL_OPT_LEVEL=2 cargo_tool cargo-about 0.9.3 --no-default-features --features cli
# Licences are read from the sources of all crates, those for other systems included.
cargo fetch --locked
"$tool" --color never generate --offline --fail --locked --manifest-path crates/sgc/Cargo.toml --features sros2,zenoh \
    --config dist/about.toml --output-file "$stage/share/doc/licences.txt" dist/about.hbs
cp NOTICE LICENSE README.md CHANGELOG.md "$stage/share/doc"
cp -r dist/examples "$stage/share/doc"
cp -r dist/grafana "$stage/share/doc/examples"
install -D -m 644 -t "$stage/share/doc/examples/prometheus" dist/prometheus/alerts.yml
mkdir -p "$stage/lib/systemd/system" "$stage/lib/sysusers.d" "$stage/lib/tmpfiles.d"
cp dist/systemd/sgc@.service "$stage/lib/systemd/system"
cp dist/systemd/sysusers.conf "$stage/lib/sysusers.d/sgc.conf"
cp dist/systemd/tmpfiles.conf "$stage/lib/tmpfiles.d/sgc.conf"

cargo_tool cargo-cyclonedx 0.5.9
# It writes beside each manifest of the workspace; that of the program has them all.
"$tool" cyclonedx --quiet --manifest-path crates/sgc/Cargo.toml --features sros2,zenoh --target "$target" --format json --spec-version 1.5 --no-build-deps \
    --override-filename sgc.cdx
# Paths of the machine that built it say nothing to others.
sed "s,$root,.,g" crates/sgc/sgc.cdx.json >"$out/$name.cdx.json"
rm -f crates/*/sgc.cdx.json

cargo_tool cargo-deb 3.8.0 --no-default-features
# It warns that it does not build the files of the stage, which it is not to.
"$tool" --no-build --no-strip -p sgc --target "$target" --output "$out" 2> >(grep -v 'will not be built' >&2)
dpkg-deb --field "$out"/*.deb Depends | grep -q libc6 || die "the package does not name the libraries that it needs (dpkg-shlibdeps)"
tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$(git log -1 --format=%ct 2>/dev/null || date +%s)" \
    --transform "s,^\.,$name," -C "$stage" -czf "$out/$name.tar.gz" .
(cd "$out" && sha256sum -- *.deb *.tar.gz *.json >SHA256SUMS)
say "target/dist has:"
(cd "$out" && ls -sh1 -- *.deb *.tar.gz *.json SHA256SUMS)
