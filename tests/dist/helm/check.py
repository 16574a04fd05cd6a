"""Checks the chart dist/helm/sgc-router with each file of values here (scripts/helm-lint.sh).

Kubernetes itself is not here. The objects are compared with its schemas, and as root a router runs as the pod would run
it: with the owners and modes that volumes have there, as the pod's user, without capabilities, on a read-only root.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

import kubernetes_validate
import yaml

HERE = Path(__file__).parent
CHART = HERE.parents[2] / "dist/helm/sgc-router"
HELM = Path(sys.executable).parent / "helm"
RELEASE = "sgc-router"
# The oldest that Chart.yaml names, and the newest that the validator knows.
KUBERNETES = ("1.27", "1.37")
# Resources of an operator, of which the validator has no schema.
FOREIGN = {"ServiceMonitor"}
STATE, RUN, CONFIG, IDENTITIES = "/var/lib/sgc", "/run/sgc", "/etc/sgc", "/identities"
USER = 7447
# Longest time that a router may take to answer.
READY_MAX = 20.0
ONE = ["--values", str(HERE / "one.yaml")]
# Values that a user may get wrong, and a word of the message.
WRONG = {
    "a chart without a Secret": ([], "existingSecret"),
    "no router": ([*ONE, "--set", "replicas=0"], "replicas"),
    "a key with a typing error": ([*ONE, "--set", "replica=2"], "replica"),
    "no listener": ([*ONE, "--set", "listen.quic.enabled=false,listen.tls.enabled=false"], "listen.quic"),
    "a privileged port": ([*ONE, "--set", "listen.quic.port=443"], "port"),
    "a router without a scheme": ([*ONE, "--set", "routers={router.lab.example}"], "routers"),
    "a rate without a unit": ([*ONE, "--set-string", "peerRate=100"], "peerRate"),
}


def helm(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([HELM, *args], capture_output=True, text=True, check=False)


def good(done: subprocess.CompletedProcess[str]) -> str:
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, done.args))}: {done.stdout}{done.stderr}")
    return done.stdout


def objects(*args: str) -> list[dict]:
    return [each for each in yaml.safe_load_all(good(helm("template", RELEASE, str(CHART), *args))) if each]


def of_kind(all_objects: list[dict], kind: str) -> list[dict]:
    return [each for each in all_objects if each["kind"] == kind]


def check_objects(all_objects: list[dict]) -> None:
    for each in all_objects:
        for version in KUBERNETES:
            if each["kind"] not in FOREIGN:
                kubernetes_validate.validate(each, version, strict=True)
    (stateful_set,) = of_kind(all_objects, "StatefulSet")
    spec = stateful_set["spec"]
    pod = spec["template"]["spec"]
    labels = spec["template"]["metadata"]["labels"]
    ports = {port["name"]: (port["protocol"], port["containerPort"]) for port in pod["containers"][0]["ports"]}
    services = {each["metadata"]["name"]: each for each in of_kind(all_objects, "Service")}
    name = stateful_set["metadata"]["name"]
    assert set(services) == {name, *(f"{name}-{number}" for number in range(spec["replicas"]))}, services.keys()
    for service in services.values():
        selector = dict(service["spec"]["selector"])
        selector.pop("statefulset.kubernetes.io/pod-name", None)
        assert selector.items() <= labels.items(), service
        for port in service["spec"]["ports"]:
            assert ports[port["targetPort"]][0] == port["protocol"], service
    reached = {port["name"] for each in services.values() for port in each["spec"]["ports"]}
    assert reached == set(ports), (reached, ports)
    for container in pod["initContainers"] + pod["containers"]:
        security = container["securityContext"]
        assert security["readOnlyRootFilesystem"] and security["capabilities"] == {"drop": ["ALL"]}, security
    claims = {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", [])}
    volumes = {volume["name"] for volume in pod["volumes"]} | claims
    mounted = {mount["name"] for each in pod["initContainers"] + pod["containers"] for mount in each["volumeMounts"]}
    assert mounted == volumes, (mounted, volumes)
    for monitor in of_kind(all_objects, "ServiceMonitor"):
        wanted = monitor["spec"]["selector"]["matchLabels"].items()
        (monitored,) = (each for each in services.values() if wanted <= each["metadata"]["labels"].items())
        assert monitor["spec"]["endpoints"][0]["port"] in {port["name"] for port in monitored["spec"]["ports"]}


def configurations(all_objects: list[dict]) -> dict[str, str]:
    (config,) = of_kind(all_objects, "ConfigMap")
    return config["data"]


def check_configurations(sgc: Path, fleet: Path, all_objects: list[dict]) -> None:
    """Each router's file, which dials the routers before it."""
    (stateful_set,) = of_kind(all_objects, "StatefulSet")
    name, replicas = stateful_set["metadata"]["name"], stateful_set["spec"]["replicas"]
    made = configurations(all_objects)
    assert set(made) == {f"{name}-{number}.toml" for number in range(replicas)}, made.keys()
    for number in range(replicas):
        text = made[f"{name}-{number}.toml"]
        dialled = [lower for lower in range(replicas) if f"//{name}-{lower}.{name}:" in text]
        assert dialled == list(range(number)), text
        file = fleet / "sgc.toml"
        file.write_text(text.replace(STATE, str(fleet)))
        environment = {"PATH": os.environ["PATH"], "STATE_DIRECTORY": str(fleet)}
        good(subprocess.run([sgc, "check", "-c", file], capture_output=True, text=True, env=environment, check=False))


def run_as_pod(sgc: Path, fleet: Path, all_objects: list[dict]) -> None:
    """Runs the containers of the first router's pod in a mount and a network namespace."""
    (stateful_set,) = of_kind(all_objects, "StatefulSet")
    pod = f"{stateful_set['metadata']['name']}-0"
    containers = stateful_set["spec"]["template"]["spec"]
    (init,), (router,) = containers["initContainers"], containers["containers"]
    (fleet / "config").mkdir()
    for name, text in configurations(all_objects).items():
        (fleet / "config" / name).write_text(text)
    environment = [f"POD_NAME={pod}", *(f"{e['name']}={e['value']}" for e in router["env"] if "value" in e)]
    quoted = lambda words: " ".join("'" + word.replace("'", "'\\''") + "'" for word in words)  # noqa: E731
    # A root of its own with the system's programs, and the volumes as the kubelet makes them for `fsGroup`. Nothing is
    # mounted or made outside of it.
    script = f"""
        set -eu
        ip link set lo up
        root={fleet}/root
        mkdir $root
        mount -t tmpfs none $root
        mkdir -p $root/proc $root/dev $root{STATE} $root{RUN} $root{CONFIG} $root{IDENTITIES}
        for place in /usr /bin /sbin /lib /lib64; do
            if [ -L $place ]; then cp -P $place $root$place; elif [ -d $place ]; then
                mkdir $root$place && mount --bind $place $root$place
            fi
        done
        mount --bind /dev $root/dev
        mount -t tmpfs -o mode=2775,gid={USER} none $root{STATE}
        mount -t tmpfs -o mode=2777,gid={USER} none $root{RUN}
        mount -t tmpfs -o mode=2755,gid={USER} none $root{IDENTITIES}
        cp {fleet}/config/* $root{CONFIG}
        install -m 0440 -g {USER} {fleet}/router.identity $root{IDENTITIES}/{pod}.identity
        install -m 0755 {sgc} $root/sgc
        mount -t proc none $root/proc
        mount -o remount,ro $root
        inside() {{
            exec chroot $root env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin {quoted(environment)} \
                setpriv --reuid {USER} --regid {USER} --clear-groups --no-new-privs --bounding-set -all --inh-caps -all "$@"
        }}
        identity() {{
            (inside sh -c 'cd {STATE} && exec "$@"' - {quoted(init["command"] + init["args"])})
        }}
        identity
        echo renewed >>$root{STATE}/router.identity
        identity    # must not undo what the node did with its copy
        grep -q renewed $root{STATE}/router.identity
        rm $root{STATE}/given.identity
        identity
        inside /sgc {quoted(router["args"]).replace("$(POD_NAME)", pod)} 2>{fleet}/router.log &
        node=$!
        {sys.executable} -B {HERE}/check.py --probe {quoted([json.dumps(router)])} &&
            (inside /sgc status --json) >{fleet}/status.json || {{ cat {fleet}/router.log >&2; kill $node; exit 1; }}
        kill $node
        wait $node
    """
    if subprocess.run(["unshare", "--mount", "--net", "sh", "-c", script], check=False).returncode != 0:
        sys.exit("the router does not run as in its pod")
    status = json.loads((fleet / "status.json").read_text())
    assert status["node"] == "router", status


def probe(router: dict) -> None:
    """Asks as the probes do, until all succeed."""
    ports = {port["name"]: port["containerPort"] for port in router["ports"]}
    for key in ("startupProbe", "livenessProbe", "readinessProbe"):
        get = router[key]["httpGet"]
        url = f"http://127.0.0.1:{ports[get['port']]}{get['path']}"
        deadline = time.monotonic() + READY_MAX
        while True:
            try:
                with urllib.request.urlopen(url, timeout=router[key].get("timeoutSeconds", 1)) as answer:
                    assert answer.status == 200
                break
            except (urllib.error.URLError, ConnectionError) as error:
                if time.monotonic() > deadline:
                    sys.exit(f"{key} {url}: {error}")
                time.sleep(0.05)


def main() -> None:
    if sys.argv[1] == "--probe":
        probe(json.loads(sys.argv[2]))
        return
    sgc = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder:
        fleet = Path(folder)
        for command in ("fleet create lab", "fleet enroll router --role router"):
            good(subprocess.run([sgc, *command.split()], capture_output=True, text=True, cwd=fleet, check=False))
        for values in sorted(HERE.glob("*.yaml")):
            good(helm("lint", "--strict", str(CHART), "--values", str(values)))
            made = objects("--values", str(values))
            check_objects(made)
            check_configurations(sgc, fleet, made)
            print(f"{values.name}: {len(made)} objects, {len(configurations(made))} configurations")
        for what, (args, word) in WRONG.items():
            done = helm("template", RELEASE, str(CHART), *args)
            assert done.returncode != 0 and word in done.stderr, f"{what}: {done.stdout}{done.stderr}"
        print(f"{len(WRONG)} mistakes are refused")
        if os.geteuid() != 0:
            print("NOT ROOT: no router runs as in its pod")
            return
        run_as_pod(sgc, fleet, objects(*ONE))
        print("a router runs as in its pod")


if __name__ == "__main__":
    main()
