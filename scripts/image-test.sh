#!/usr/bin/env bash
# Builds the image on a small Debian of its own, and tries the page docs/how-to/containers.md with it: the three nodes of
# dist/container/compose.yaml, a topic between them, a health check, a mistake, `kill -9` and a restart. Needs root, and the
# web once for the Debian. It leaves no container, network, volume or image.
#   SGC_DIST_SUITE    the release of Debian (that of this machine)
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

PATIENCE_SECONDS=60
# shellcheck source=/dev/null
suite=${SGC_DIST_SUITE:-$(. /etc/os-release && echo "$VERSION_CODENAME")}
debian=target/dist-test/$suite-image
# Nobody's own images and containers are touched: all state is below this directory.
store=target/image-test
[ "$(id -u)" = 0 ] || die "needs root, for the containers"

if [ ! -e "$debian/.complete" ]; then
    say "making a Debian $suite in $debian (a minute, once)"
    rm -rf "$debian"
    debootstrap --variant=minbase "$suite" "$debian" >/dev/null
    touch "$debian/.complete"
fi

wrapper=$PWD/$store/bin
mkdir -p "$wrapper"
cat >"$wrapper/podman" <<PODMAN
#!/bin/sh
exec $(command -v podman) --root $PWD/$store/storage --runroot $PWD/$store/run --storage-driver vfs --cgroup-manager cgroupfs \\
    --events-backend file "\$@"
PODMAN
chmod +x "$wrapper/podman"
export PATH=$wrapper:$PATH
compose() { (cd dist/container && SGC_IMAGE=localhost/sgc-test podman-compose --project-name sgctest "$@"); }
clean() {
    compose down --volumes >/dev/null 2>&1 || true
    podman network rm -f sgctest_robot-site sgctest_desk-site >/dev/null 2>&1 || true
    podman system reset --force >/dev/null 2>&1 || true
    rm -rf "$store"
}
trap clean EXIT

passed=0
check() {
    local what=$1
    shift
    "$@" || die "$what"
    passed=$((passed + 1))
}
eventually() {
    local what=$1 until=$((SECONDS + PATIENCE_SECONDS))
    shift
    until "$@"; do
        [ "$SECONDS" -lt "$until" ] || {
            compose logs 2>&1 | tail -n 30
            die "never: $what"
        }
        sleep 0.2
    done
    passed=$((passed + 1))
}
in_node() { podman exec "sgctest_$1_1" "${@:2}"; }

say "building the image"
tar -C "$debian" -c . | podman import --quiet - localhost/debian-small >/dev/null
SGC_IMAGE_BASE=localhost/debian-small scripts/image.sh localhost/sgc-test
check "the image is not of a user of its own" test "$(podman image inspect --format '{{.User}}' localhost/sgc-test)" = sgc
check "the program does not run" sh -c "podman run --rm localhost/sgc-test --version | grep -q '^sgc '"

say "a mistake is told"
said=$(podman run --rm --read-only localhost/sgc-test 2>&1) && die "a node without a configuration runs"
check "a missing configuration is not named: $said" grep -q '/etc/sgc/sgc.toml' <<<"$said"

say "router, robot and desk"
compose run --rm setup >/dev/null 2>&1
compose run --rm setup >/dev/null 2>&1 # a second time changes nothing
compose up --detach >/dev/null 2>&1
is_linked() { in_node "$1" sgc status --json | grep -q '"state":"linked"'; }
eventually "the robot is linked" is_linked robot 2>/dev/null
eventually "the desk is linked" is_linked desk 2>/dev/null
check "the root can be written to" sh -c "! podman exec sgctest_robot_1 touch /x 2>/dev/null"
check "the node is root" test "$(in_node robot id -u)" = 7447
check "an identity is not its user's alone" test "$(in_node robot stat -c %a:%U /var/lib/sgc/robot.identity)" = 600:sgc
podman exec --detach sgctest_robot_1 sgc topic pub /chatter std_msgs/msg/String '{data: hello}' --rate 10
hears() { timeout 10 podman exec sgctest_desk_1 sgc topic echo /chatter --count 1 2>/dev/null | grep -q hello; }
eventually "the desk hears the robot" hears
eventually "it is healthy" sh -c "podman healthcheck run sgctest_robot_1 >/dev/null 2>&1"

say "kill -9 and a restart"
podman kill --signal KILL sgctest_robot_1 >/dev/null
check "a dead node is healthy" sh -c "! podman healthcheck run sgctest_robot_1 >/dev/null 2>&1"
podman start sgctest_robot_1 >/dev/null
eventually "it is linked again" is_linked robot 2>/dev/null
started=$(date +%s)
podman stop --time 10 sgctest_router_1 >/dev/null
check "it does not stop on SIGTERM" test $(($(date +%s) - started)) -lt 8
check "it did not end well" test "$(podman inspect --format '{{.State.ExitCode}}' sgctest_router_1)" = 0
say "the image passed $passed checks"
