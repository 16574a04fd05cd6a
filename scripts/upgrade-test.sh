#!/usr/bin/env bash
# Runs nodes of this version and of an earlier one together: each of them as router, robot and desk, between programs of
# ROS 2 Jazzy and Kilted, and an upgrade and a downgrade of each while a topic flows. Needs root for a network of its own.
#   SGC_OLD    the earlier version: a commit, or a program
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

old=${SGC_OLD:-$(git describe --tags --abbrev=0 2>/dev/null || git rev-parse HEAD~1)}
new=$(realpath -m "${CARGO_TARGET_DIR:-target}")/debug/sgc
place=$root/target/upgrade-test

# inside: everything below runs in a network and a /dev/shm of its own.
if [ "${1:-}" != inside ]; then
    [ "$(id -u)" = 0 ] || die "needs root, for a network of its own"
    scripts/build-ros2.sh
    mkdir -p "$place"
    if [ -f "$old" ] && [ -x "$old" ]; then
        old=$(realpath "$old")
    else
        commit=$(git rev-parse --short=8 "$old^{commit}")
        program=$place/sgc-$commit
        if [ ! -x "$program" ]; then
            say "building $commit in $place (some minutes, once)"
            rm -rf "$place/source"
            git worktree prune
            git worktree add --quiet --detach "$place/source" "$commit"
            (cd "$place/source" && CARGO_TARGET_DIR=$place/build cargo build --locked -p sgc --features sgc/sros2)
            cp "$place/build/debug/sgc" "$program"
            git worktree remove --force "$place/source"
        fi
        old=$program
    fi
    cargo build --locked -p sgc --features sgc/sros2,sgc/zenoh
    exec unshare --net --mount --kill-child --fork env SGC_OLD="$old" "$root/scripts/upgrade-test.sh" inside
fi

mount -t tmpfs none /dev/shm
ip link set lo up multicast on
work=$(mktemp -d)
export XDG_RUNTIME_DIR=$work/run XDG_STATE_HOME=$work/state HOME=$work ROS_LOCALHOST_ONLY=1
mkdir -m 700 "$XDG_RUNTIME_DIR" "$XDG_STATE_HOME"
cd "$work"
declare -A pids
cleanup() {
    local pid
    for pid in "${pids[@]}"; do kill -9 "$pid" 2>/dev/null || true; done
    rm -rf "$work"
}
trap cleanup EXIT

# The files are of the earlier version, as they are after an upgrade.
"$old" fleet create lab --authority keeper >/dev/null
"$old" fleet enroll router --role router >/dev/null 2>&1 || "$old" fleet enroll router --router >/dev/null
for node in keeper robot desk; do "$old" fleet enroll "$node" >/dev/null; done
cat >router.toml <<'END'
identity = "router.identity"
[router]
listen = ["quic://127.0.0.1:7447"]
END
for node in keeper robot desk; do
    printf 'identity = "%s.identity"\n[node]\nrouters = ["quic://127.0.0.1:7447"]\n' "$node" >"$node.toml"
done
printf '[authority]\nfleet = "lab.fleet"\n' >>keeper.toml
printf '[ros]\ndomain_id = 31\n[[share]]\ntopic = "/chatter"\nto = ["desk"]\n' >>robot.toml
printf '[ros]\ndomain_id = 32\n[[use]]\nfrom = "robot"\ntopic = "/chatter"\n' >>desk.toml

start() { # NODE PROGRAM
    local node=$1 program=$2
    "$program" run -c "$node.toml" >>"$node.log" 2>&1 &
    pids[$node]=$!
}
stop() { # NODE [SIGNAL]
    kill "-${2:-TERM}" "${pids[$1]}"
    wait "${pids[$1]}" 2>/dev/null || true
    unset "pids[$1]"
}
peer() { ROS_DOMAIN_ID=$1 timeout 60 "$root/.peers/$2/bin/python" -B "$root/tests/dist/chatter.py" "${@:3}"; }
flows() { # WHAT
    if ! peer 32 kilted hear 30 >heard.log 2>&1; then
        cat heard.log
        tail -n 20 ./*.log
        die "$1: nothing is heard"
    fi
    say "ok: $1"
}
name_of() { [ "$1" = "$new" ] && echo new || echo old; }

(while true; do peer 31 jazzy talk 50 || true; done) >talker.log 2>&1 &
pids[talker]=$!
disown
for router in "$old" "$new"; do
    for robot in "$old" "$new"; do
        for desk in "$old" "$new"; do
            start router "$router"
            start robot "$robot"
            start desk "$desk"
            flows "router $(name_of "$router"), robot $(name_of "$robot"), desk $(name_of "$desk")"
            stop desk
            stop robot
            stop router
        done
    done
done

# One after the other, in the order that the page of versions names, and back.
start router "$old"
start keeper "$old"
start robot "$old"
start desk "$old"
flows "all are old"
for direction in "$new" "$old"; do
    for node in router keeper desk robot; do
        stop "$node" KILL
        start "$node" "$direction"
        flows "$node becomes $(name_of "$direction")"
    done
done

say "the versions work together"
