#!/bin/bash
# Runs in the container of scripts/dist-test.sh, as root: what somebody types who follows docs/how-to/install.md and
# docs/how-to/fleet.md, from the package to the first topic and the dashboard. Prints each command with its time.
# Three machines are one here: the hub (router, authority and keeper), a robot and a desk, each with a service of its own.
set -uo pipefail
cd /test

commands=0
begun=$(date +%s%N)
fail() {
    echo "FAILED: $*"
    journalctl --no-pager -n 60 -u 'sgc@*'
    echo failed >result
    systemctl poweroff
    exit 1
}
# types WHERE COMMAND: a line that the user types, and how long it took.
types() {
    local where=$1 command=$2 at
    at=$(date +%s%N)
    (cd /var/lib/sgc 2>/dev/null; bash -c "$command") >out 2>&1 || { cat out; fail "$command"; }
    commands=$((commands + 1))
    printf '%2d %-6s %5d ms  %s\n' "$commands" "$where" $((($(date +%s%N) - at) / 1000000)) "$command"
}
ros() { env ROS_DOMAIN_ID="$1" HOME=/tmp "/ros/$2/bin/python" -B /test/chatter.py "${@:3}"; }
for distribution in jazzy kilted; do
    mkdir -p "/ros/$distribution/bin"
    ln -s /usr/bin/python3 "/ros/$distribution/bin/python"
    printf 'home = /usr/bin\ninclude-system-site-packages = false\n' >"/ros/$distribution/pyvenv.cfg"
    ln -s "/peers/$distribution/lib" "/peers/$distribution/share" "/ros/$distribution"
done

types hub 'dpkg -i /test/first.deb'
types hub 'runuser -u sgc -- sgc fleet create lab --authority hub'
types hub 'runuser -u sgc -- sgc fleet enroll hub --may-route --group observers'
types hub 'printf "identity = \"/var/lib/sgc/hub.identity\"\n[router]\nlisten = [\"quic://127.0.0.1:7447\"]\n[authority]\nfleet = \"/var/lib/sgc/lab.fleet\"\n" >/etc/sgc/hub.toml'
types hub 'systemctl enable --now sgc@hub'
types hub 'runuser -u sgc -- sgc fleet invite robot --via quic://127.0.0.1:7447 2>/dev/null >/test/robot.code'
types robot 'sgc join --service robot </test/robot.code'
types robot 'printf "[ros]\ndomain_id = 31\n[[share]]\ntopic = \"/chatter\"\nto = [\"desk\"]\n" >>/etc/sgc/robot.toml'
types robot 'systemctl enable --now sgc@robot'
types hub 'runuser -u sgc -- sgc fleet invite desk --via quic://127.0.0.1:7447 2>/dev/null >/test/desk.code'
types desk 'sgc join --service desk </test/desk.code'
types desk 'printf "[ros]\ndomain_id = 32\n[[use]]\nfrom = \"robot\"\ntopic = \"/chatter\"\n" >>/etc/sgc/desk.toml'
types desk 'systemctl enable --now sgc@desk'
ros 31 jazzy talk 60 >talk.log 2>&1 &
at=$(date +%s%N)
ros 32 kilted hear 40 >out 2>&1 || { cat out; fail "no message"; }
echo "   desk   $((($(date +%s%N) - at) / 1000000)) ms until a subscriber of ROS 2 Kilted hears the talker of Jazzy, its own start included"
types hub 'sgc fleet status robot --node hub'
sgc dashboard --node hub --listen 127.0.0.1:7480 >dashboard.log 2>&1 &
for _ in $(seq 50); do grep -q '#' dashboard.log && break; sleep 0.1; done
commands=$((commands + 1))
python3 - <<'END' || fail "no dashboard"
import re, urllib.request
url = re.search(r"http://\S+", open("dashboard.log").read()).group(0)
page = urllib.request.urlopen(url.split("#")[0], timeout=5).read().decode()
assert "<title>" in page, page[:200]
END
echo "$commands commands, $((($(date +%s%N) - begun) / 1000000000)) s from the package to the dashboard"
echo passed >result
systemctl poweroff
