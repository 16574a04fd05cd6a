#!/bin/bash
# Runs in the container of scripts/dist-test.sh at each boot, as root. The first boot installs, the second goes on after it.
set -uo pipefail
cd /test

fail() {
    echo "FAILED: $*"
    journalctl --no-pager -n 60 -u 'sgc@*'
    echo failed >result
    systemctl poweroff
    exit 1
}
# expect WHAT COMMAND…: the command succeeds.
expect() {
    local what=$1
    shift
    "$@" >out 2>&1 || { cat out; fail "$what"; }
    echo "ok: $what"
}
# refuse WHAT TEXT COMMAND…: the command fails and says TEXT.
refuse() {
    local what=$1 text=$2
    shift 2
    "$@" >out 2>&1 && fail "$what: it succeeded"
    grep -qF -- "$text" out || { cat out; fail "$what: it does not say \"$text\""; }
    echo "ok: $what"
}
# soon WHAT SECONDS COMMAND…: the command succeeds within that time.
soon() {
    local what=$1 seconds=$2
    shift 2
    for _ in $(seq $((seconds * 5))); do
        "$@" >out 2>&1 && { echo "ok: $what"; return; }
        sleep 0.2
    done
    cat out
    fail "$what: not within $seconds s"
}
is_linked() { sgc status --node robot | grep -qx 'Links:'; }
is_arm_linked() { sgc status -c /etc/sgc/arm-service.toml | grep -qx 'Links:'; }
scrape() { python3 -c 'import urllib.request as web; assert b"sgc_links{" in web.urlopen("http://127.0.0.1:9464/metrics", timeout=5).read()'; }
journal() { journalctl --sync; journalctl --no-pager -u "sgc@$1"; }
pid() { systemctl show --value -p MainPID "sgc@$1"; }
is_new() { [ "$(pid robot)" != "$1" ] && [ "$(pid robot)" != 0 ]; }
ros() { as member env ROS_DOMAIN_ID="$1" HOME=/home/member "/ros/$2/bin/python" -B /test/chatter.py "${@:3}"; }
as() { runuser -u "$1" -- env HOME="$(getent passwd "$1" | cut -d: -f6)" "${@:2}"; }

if [ ! -e rebooted ]; then
    expect "it installs" dpkg -i first.deb
    expect "the user exists" id sgc
    expect "the version names a commit" grep -qE '^sgc [0-9.]+ \([0-9a-f]+' <(sgc --version)
    expect "completions are installed" bash -c '. /usr/share/bash-completion/completions/sgc && complete -p sgc'
    expect "man pages are installed" test -e /usr/share/man/man1/sgc-run.1.gz
    expect "a fleet is made" sgc fleet create lab --authority keeper
    expect "a router is enrolled" sgc fleet enroll router --role router
    expect "a robot is enrolled" sgc fleet enroll robot
    expect "a desk is enrolled" sgc fleet enroll desk
    expect "the authority is enrolled" sgc fleet enroll keeper
    sed 's,tls://0.0.0.0:443,tls://127.0.0.1:443,; s,0.0.0.0,127.0.0.1,' /usr/share/doc/sgc/examples/router.toml >/etc/sgc/router.toml
    sed 's,router.example,127.0.0.1,' /usr/share/doc/sgc/examples/robot.toml >/etc/sgc/robot.toml
    # Its domain reaches the service as a variable.
    echo ROS_DOMAIN_ID=31 >/etc/sgc/robot.env
    cat >/etc/sgc/desk.toml <<'END'
identity = "/var/lib/sgc/desk.identity"
[node]
routers = ["quic://127.0.0.1:7447"]
[ros]
domain_id = 32
[[use]]
from = "robot"
topic = "/chatter"
END

    cat >/etc/sgc/keeper.toml <<'END'
identity = "/var/lib/sgc/keeper.identity"
[node]
routers = ["quic://127.0.0.1:7447"]
[authority]
fleet = "/var/lib/sgc/lab.fleet"
END

    # Mistakes first.
    refuse "a node without its identity does not start" "failed" systemctl enable --now sgc@robot
    expect "it is not tried again" test "$(systemctl is-active sgc@robot)" = failed
    expect "the journal names the file" grep -qF /var/lib/sgc/robot.identity <(journal robot)
    cp robot.identity /var/lib/sgc/
    refuse "an identity of root cannot be read" "failed" systemctl start sgc@robot
    expect "the journal says how to give it to the service" grep -qF 'chown sgc' <(journal robot)
    install -o sgc -g sgc -m 600 ./*.identity /var/lib/sgc/

    expect "the router starts" systemctl enable --now sgc@router
    expect "the robot starts" systemctl start sgc@robot
    soon "both are linked" 10 is_linked
    refuse "two nodes have to be named" "--node: " sgc status
    expect "root finds a node by its name" sgc status --node router
    expect "and by its configuration" sgc status -c /etc/sgc/robot.toml
    printf '\n[metrics]\n' >>/etc/sgc/router.toml
    soon "a running node serves metrics" 10 scrape
    expect "alert rules and a dashboard are installed" test -e /usr/share/doc/sgc/examples/prometheus/alerts.yml -a -e /usr/share/doc/sgc/examples/grafana/sgc.json
    expect "the router listens on port 443" grep -q ':443 ' <(ss -Hltn)
    useradd -m member -G sgc
    useradd -m stranger
    expect "a member of the group asks" as member sgc status --node robot
    refuse "a stranger is told how to" "sudo" as stranger sgc status
    refuse "also by name" "sudo" as stranger sgc status --node robot
    # The environments of ROS 2 with the Python of this system.
    for distribution in jazzy kilted; do
        mkdir -p "/ros/$distribution/bin"
        ln -s /usr/bin/python3 "/ros/$distribution/bin/python"
        printf 'home = /usr/bin\ninclude-system-site-packages = false\n' >"/ros/$distribution/pyvenv.cfg"
        ln -s "/peers/$distribution/lib" "/peers/$distribution/share" "/ros/$distribution"
    done
    # A machine joins by a code, as the guide says.
    install -o sgc -g sgc -m 600 lab.fleet /var/lib/sgc/
    expect "the authority starts" systemctl start sgc@keeper
    as sgc sgc fleet invite arm --fleet /var/lib/sgc/lab.fleet --via quic://127.0.0.1:7447 >code || fail "no code"
    refuse "a user who may not write there keeps the code" "/var/lib/sgc" as stranger sgc join --service arm-service "$(cat code)"
    expect "root joins by it" sgc join --service arm-service "$(cat code)"
    expect "the identity is the service's" test "$(stat -c '%U %a' /var/lib/sgc/arm-service.identity)" = "sgc 600"
    expect "the service starts under another name than the node" systemctl enable --now sgc@arm-service
    soon "and links" 10 is_arm_linked
    refuse "the code is used up" "was used" sgc join --dir /root "$(cat code)"
    expect "it is stopped" systemctl disable --now sgc@arm-service
    expect "a desk starts" systemctl start sgc@desk
    ros 31 jazzy talk 60 >talk.log 2>&1 &
    expect "a message crosses from ROS 2 Jazzy to Kilted" ros 32 kilted hear 40
    expect "sgc shows it" timeout 20 sgc topic echo --node desk --once /chatter
    expect "the audit log is found" sgc audit -c /etc/sgc/robot.toml
    expect "also by name" sgc audit --node robot
    expect "sgc check does not mind whose the state is" test -z "$(sgc check -c /etc/sgc/robot.toml | grep 'state directory')"
    expect "the service's user makes a token" as sgc sgc token access create -c /etc/sgc/robot.toml --for test --subscribe /chatter
    token=$(as sgc sgc token access list -c /etc/sgc/robot.toml | awk 'NR == 2 { print $1 }')
    expect "and revokes it" as sgc sgc token access revoke -c /etc/sgc/robot.toml "$token"
    cp out said
    expect "the running node hears of it" grep -q 'The node that runs knows it' said
    expect "the log has version, node and role in a line" grep -qE 'sgc [0-9.]+ \(.*\): node robot of fleet lab, proxy of ROS domain 31, configured by /etc/sgc/robot.toml' <(journal robot)

    expect "a line of the journal has one time" grep -qE '\]: +INFO sgc_node' <(journal robot)

    before=$(pid robot)
    printf '\n[[share]]\ntopic = "/odom"\nto = ["desk"]\n' >>/etc/sgc/robot.toml
    expect "it reloads" systemctl reload sgc@robot
    expect "the share is there" grep -q /odom <(sgc topic list --node robot; sgc status --node robot --json)
    expect "it is the same process" test "$(pid robot)" = "$before"
    echo 'wrong = 1' >>/etc/sgc/robot.toml
    refuse "a wrong configuration is refused" "" systemctl reload sgc@robot
    expect "the node goes on" test "$(pid robot)" = "$before"
    sed -i '/^wrong/d' /etc/sgc/robot.toml

    kill -9 "$before"
    soon "a killed node is started again" 15 is_new "$before"
    soon "and links" 15 is_linked
    before=$(pid robot)
    kill -STOP "$before"
    soon "a node that hangs is ended by the watchdog and started again" 60 is_new "$before"
    soon "and links" 15 is_linked
    expect "systemd-analyze security" systemd-analyze security --no-pager sgc@robot
    tail -n 1 out
    touch rebooted
    sync
    systemctl reboot
    exit
fi

soon "the nodes are up after a reboot" 20 is_linked
before=$(pid robot)
expect "it upgrades" dpkg -i later.deb
soon "the nodes run the new program" 20 is_new "$before"
soon "and link" 15 is_linked
expect "it can be removed" dpkg -r sgc
expect "the nodes are stopped" test "$(systemctl is-active sgc@robot)" != active
expect "identities stay" test -e /var/lib/sgc/robot.identity
expect "it installs again" dpkg -i first.deb
expect "the nodes start" systemctl start sgc@router sgc@robot
rm /var/lib/sgc/lab.fleet
expect "it can be purged" dpkg -P sgc
expect "identities are gone" test ! -e /var/lib/sgc
expect "configurations stay" test -e /etc/sgc/robot.toml
expect "no enabled unit is left" test -z "$(find /etc/systemd -name 'sgc@*')"
echo passed >result
systemctl poweroff
