#!/usr/bin/env bash
# Tries the package of target/dist on a small Debian whose systemd runs in a container: installs it, runs three nodes as
# services between programs of ROS 2, reboots, upgrades, breaks things, removes and purges it. Needs root, and the web once for
# the Debian and for ROS 2.
# With `new-user`, plays somebody who follows the guides from the package to the first topic, and prints commands and times.
#   SGC_DIST_SUITE    the release of Debian (that of this machine)
#   SGC_OLD           the earlier program that is upgraded (this one)
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

PATIENCE_SECONDS=420
plays=${1:-in-container}
# The exit code of a container that reboots (EXIT_FORCE_RESTART).
REBOOTS=133
# shellcheck source=/dev/null
suite=${SGC_DIST_SUITE:-$(. /etc/os-release && echo "$VERSION_CODENAME")}
place=target/dist-test
base=$place/$suite
[ "$(id -u)" = 0 ] || die "needs root, for the container"
package=$(ls target/dist/*.deb) || die "no package in target/dist: make dist"
scripts/build-ros2.sh

if [ ! -e "$base/.complete" ]; then
    say "making a Debian $suite in $base (a minute, once)"
    rm -rf "$base"
    mkdir -p "$place"
    debootstrap --variant=minbase --include=systemd,systemd-sysv,iproute2,bash-completion,python3 "$suite" "$base" >"$place/debootstrap.log"
    touch "$base/.complete"
fi
machine=$place/machine
rm -rf "$machine" "$place/console.log"
cp -a "$base" "$machine"

mkdir "$machine/test"
cp "tests/dist/$plays.sh" tests/dist/chatter.py "$machine/test"
# Makes a package of the same files: NAME, what follows its version, and another program if there is one.
repack() {
    local parts=$place/$1
    rm -rf "$parts"
    dpkg-deb -R "$package" "$parts"
    sed -i "s/^Version: .*/&$2/" "$parts/DEBIAN/control"
    if [ -n "${3:-}" ]; then install -m 755 "$3" "$parts/usr/bin/sgc"; fi
    # The checksums are those of the other program.
    rm -f "$parts/DEBIAN/md5sums"
    dpkg-deb --root-owner-group -b "$parts" "$machine/test/$1.deb" >/dev/null
    rm -rf "$parts"
}
repack first '' "${SGC_OLD:-}"
repack later +later
cat >"$machine/etc/systemd/system/sgc-test.service" <<'UNIT'
[Unit]
After=multi-user.target
[Service]
ExecStart=/test/PLAYS.sh
StandardOutput=append:/test/log
StandardError=append:/test/log
[Install]
WantedBy=graphical.target
UNIT
sed -i "s/PLAYS/$plays/" "$machine/etc/systemd/system/sgc-test.service"
ln -sf /lib/systemd/system/graphical.target "$machine/etc/systemd/system/default.target"
mkdir -p "$machine/etc/systemd/system/graphical.target.wants"
ln -s ../sgc-test.service "$machine/etc/systemd/system/graphical.target.wants/"

say "booting it"
outcome=$REBOOTS
until=$((SECONDS + PATIENCE_SECONDS))
while [ "$outcome" = "$REBOOTS" ] && [ "$SECONDS" -lt "$until" ]; do
    outcome=0
    timeout $((until - SECONDS)) systemd-nspawn --quiet --boot --private-network --register=no --keep-unit \
        --bind-ro="$root/.peers:/peers" --directory "$machine" >>"$place/console.log" 2>&1 </dev/null || outcome=$?
done
cat "$machine/test/log" 2>/dev/null || true
if [ "$(cat "$machine/test/result" 2>/dev/null)" != passed ]; then
    die "the package did not pass (console: $place/console.log; exit code of the container: $outcome)"
fi
rm -rf "$machine"
say "the package passed"
