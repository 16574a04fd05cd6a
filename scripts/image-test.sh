#!/usr/bin/env bash
# Builds the image on a small Debian of its own, and tries the page docs/how-to/containers.md with it: the three nodes of
# dist/container/compose.yaml, a topic between them, a health check, a mistake, `kill -9` and a restart. Needs root, and the
# web once for the Debian. Images, containers, volumes and networks are below target/image-test, and go with it.
#   SGC_DIST_SUITE    the release of Debian (that of this machine)
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

PATIENCE_SECONDS=60
# shellcheck source=/dev/null
suite=${SGC_DIST_SUITE:-$(. /etc/os-release && echo "$VERSION_CODENAME")}
debian=target/dist-test/$suite-image
store=$PWD/target/image-test
[ "$(id -u)" = 0 ] || die "needs root, for the containers"

if [ ! -e "$debian/.complete" ]; then
    say "making a Debian $suite in $debian (a minute, once)"
    rm -rf "$debian"
    mkdir -p "$debian"
    debootstrap --variant=minbase "$suite" "$debian" >/dev/null
    touch "$debian/.complete"
fi

podman=$(command -v podman)
mkdir -p "$store/bin"
cat >"$store/bin/podman" <<PODMAN
#!/bin/sh
exec $podman --runtime runc --root $store/storage --runroot $store/run --tmpdir $store/tmp --network-config-dir $store/networks \\
    --storage-driver overlay --cgroup-manager cgroupfs --events-backend file "\$@"
PODMAN
chmod +x "$store/bin/podman"
# Its usual limits are higher than a container that runs this may set.
printf '[containers]\ndefault_ulimits = ["nofile=4096:4096", "nproc=4096:4096"]\n' >"$store/containers.conf"
export CONTAINERS_CONF=$store/containers.conf
export PATH=$store/bin:$PATH
log=$store/log
compose() { (cd dist/container && SGC_IMAGE=localhost/sgc-test podman-compose --project-name sgctest "$@") >>"$log" 2>&1; }
clean() {
    podman rm --all --force --time 0 >/dev/null 2>&1 || true
    podman volume rm --all --force >/dev/null 2>&1 || true
    for network in $(podman network ls --quiet 2>/dev/null); do
        podman network rm --force "$network" >/dev/null 2>&1 || true
    done
    umount "$store/storage/overlay" 2>/dev/null || true
    rm -rf "$store"
}
trap clean EXIT

passed=0
fail() {
    tail -n 30 "$log" >&2
    podman logs --tail 10 sgctest_robot_1 >&2 || true
    die "$1"
}
check() {
    local what=$1
    shift
    "$@" >>"$log" 2>&1 || fail "not so: $what"
    passed=$((passed + 1))
}
eventually() {
    local what=$1 until=$((SECONDS + PATIENCE_SECONDS))
    shift
    until "$@" >>"$log" 2>&1; do
        [ "$SECONDS" -lt "$until" ] || fail "never: $what"
        sleep 0.2
    done
    passed=$((passed + 1))
}

say "building the image"
tar -C "$debian" -c . | podman import --quiet - localhost/debian-small >/dev/null
SGC_IMAGE_BASE=localhost/debian-small scripts/image.sh localhost/sgc-test
check "the image has a user of its own" test "$(podman image inspect --format '{{.User}}' localhost/sgc-test)" = 7447:7447
check "the program runs" sh -c "podman run --rm localhost/sgc-test --version | grep '^sgc '"

say "a mistake is told"
said=$(podman run --rm --read-only localhost/sgc-test 2>&1) && die "a node without a configuration runs"
check "the missing file is named" grep -F /etc/sgc/sgc.toml <<<"$said"

say "router, robot and desk"
check "identities are made" compose -f setup.yaml run --rm setup
check "a second time changes nothing" compose -f setup.yaml run --rm setup
check "the nodes start" compose up --detach
is_linked() { podman exec "sgctest_$1_1" sgc status --json | grep '"state":"linked"'; }
eventually "the robot is linked" is_linked robot
eventually "the desk is linked" is_linked desk
check "the root cannot be written to, even by root" sh -c "! podman exec --user 0 sgctest_robot_1 touch /x"
check "the node is no root" test "$(podman exec sgctest_robot_1 id -u)" = 7447
check "an identity is its user's alone" test "$(podman exec sgctest_robot_1 stat -c %a:%U /var/lib/sgc/robot.identity)" = 600:sgc
check "the robot publishes" podman exec --detach sgctest_robot_1 sgc topic pub /chatter std_msgs/msg/String '{data: hello}' --rate 10
hears() { timeout 10 podman exec sgctest_desk_1 sgc topic echo --once /chatter | grep hello; }
eventually "the desk hears the robot" hears
eventually "it is healthy" podman healthcheck run sgctest_robot_1
node=$(podman inspect --format '{{.State.Pid}}' sgctest_robot_1)
kill -STOP "$node"
check "a node that hangs is not healthy" sh -c "! podman healthcheck run sgctest_robot_1"
kill -CONT "$node"

say "kill -9 and a restart"
kill -KILL "$node"
is_dead() { [ "$(podman inspect --format '{{.State.Running}}' sgctest_robot_1)" = false ]; }
is_new() { [ "$(podman inspect --format '{{.State.Pid}}' sgctest_robot_1)" != "$node" ]; }
# A service of systemd restarts it where podman runs as one.
eventually "it has ended" sh -c "$(declare -f is_dead is_new); node=$node; is_dead || is_new"
podman start sgctest_robot_1 >>"$log" 2>&1
eventually "it is linked again" is_linked robot
started=$SECONDS
podman stop --time 10 sgctest_router_1 >>"$log" 2>&1
check "it stops on SIGTERM" test $((SECONDS - started)) -lt 8
check "it ends well" test "$(podman inspect --format '{{.State.ExitCode}}' sgctest_router_1)" = 0
say "the image passed $passed checks"
