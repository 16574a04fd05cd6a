#!/usr/bin/env bash
# Puts Prometheus into .peers/prometheus, for the tests: that of the system, or Debian's package, which is unpacked and not
# installed, since an installed one would start a service.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

place=.peers/prometheus
[ ! -x $place/promtool ] || exit 0
rm -rf $place $place.new
mkdir -p $place.new
if command -v prometheus >/dev/null && command -v promtool >/dev/null; then
    ln -s "$(command -v prometheus)" "$(command -v promtool)" $place.new
else
    say "Debian's package of Prometheus in $place"
    command -v apt-get >/dev/null || die "apt-get is missing: install prometheus and promtool yourself"
    if ! apt-cache show prometheus >/dev/null 2>&1; then
        sudo=()
        [ "$(id -u)" = 0 ] || sudo=(sudo)
        "${sudo[@]}" apt-get update -qq
    fi
    (cd $place.new && apt-get download -qq prometheus 2>/dev/null && dpkg-deb -x prometheus_*.deb . && rm prometheus_*.deb)
    mv $place.new/usr/bin/prometheus $place.new/usr/bin/promtool $place.new
    rm -r $place.new/usr $place.new/etc $place.new/var $place.new/lib 2>/dev/null || true
fi
mv $place.new $place
