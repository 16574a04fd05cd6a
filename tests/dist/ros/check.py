"""Builds the package dist/ros/sgc_ros with colcon, and starts a node as its launch file says (scripts/ros-package.sh)."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import launch_stand_in

PACKAGE = Path(__file__).parents[3] / "dist/ros/sgc_ros"
BIN = Path(sys.executable).parent
DOMAIN = "71"
# Longest time that a node may take to answer, and to end.
NODE_MAX_S = 20.0


def run(*command: object, **options: object) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, **options)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}: {done.stdout}{done.stderr}")
    return done.stdout


def build(workspace: Path) -> Path:
    """Returns the directory of the built package's files."""
    shutil.copytree(PACKAGE, workspace / "src/sgc_ros")
    environment = {"PATH": f"{BIN}:{os.environ['PATH']}", "HOME": str(workspace)}
    listed = run(BIN / "colcon", "list", cwd=workspace, env=environment).split()
    assert listed == ["sgc_ros", "src/sgc_ros", "(ros.ament_python)"], listed
    run(BIN / "colcon", "build", "--packages-select", "sgc_ros", cwd=workspace, env=environment)
    share = workspace / "install/sgc_ros/share"
    assert (share / "ament_index/resource_index/packages/sgc_ros").is_file()
    assert (share / "sgc_ros/package.xml").is_file()
    return share / "sgc_ros"


def processes(launch_file: Path, **arguments: str) -> list[launch_stand_in.ExecuteProcess]:
    description = runpy.run_path(str(launch_file))["generate_launch_description"]()
    return description.visit(launch_stand_in.LaunchContext(arguments))


def check_arguments(launch_file: Path) -> None:
    (plain,) = processes(launch_file)
    assert (plain.cmd, plain.additional_env, plain.respawn) == (["sgc", "run"], None, False), vars(plain)
    (full,) = processes(
        launch_file, config="/my robot/sgc.toml", domain="7", args="--share '/camera/**' --log debug", program="/opt/sgc", respawn="true"
    )
    assert full.cmd == [
        "/opt/sgc", "run", "--config", "/my robot/sgc.toml", "--share", "/camera/**", "--log", "debug",
    ], full.cmd  # fmt: skip
    assert full.additional_env == {"ROS_DOMAIN_ID": "7"} and full.respawn and full.output == "screen", vars(full)
    try:
        processes(launch_file, respawn="yes")
    except ValueError as error:
        assert "respawn" in str(error)
    else:
        sys.exit("respawn:=yes is taken")


def run_node(sgc: Path, launch_file: Path, folder: Path) -> None:
    """Starts the process of a launch, and ends it as `ros2 launch` does, by SIGINT."""
    run(sgc, "fleet", "create", "lab", cwd=folder)
    run(sgc, "fleet", "enroll", "robot", cwd=folder)
    (folder / "robot.toml").write_text(
        f'identity = "robot.identity"\n[node]\nstate = "{folder}/state"\n[admin]\nsocket = "{folder}/robot.sock"\n'
        '[router]\nlisten = ["quic://127.0.0.1:0"]\n[ros]\ndiscovery_range = "localhost"\nstatic_peers = []\n[[share]]\ntopic = "/chatter"\nto = ["*"]\n'
    )
    (process,) = processes(launch_file, config=str(folder / "robot.toml"), domain=DOMAIN, args="--log info", program=str(sgc))
    environment = {"PATH": os.environ["PATH"], **process.additional_env}
    with open(folder / "sgc.log", "w") as log:
        node = subprocess.Popen(process.cmd, env=environment, stderr=log)
    try:
        deadline = time.monotonic() + NODE_MAX_S
        ask = [sgc, "status", "--json", "--socket", folder / "robot.sock"]
        while (answer := subprocess.run(ask, capture_output=True, check=False)).returncode != 0:
            assert node.poll() is None and time.monotonic() < deadline, (folder / "sgc.log").read_text()
            time.sleep(0.05)
        status = json.loads(answer.stdout)
        assert status["node"] == "robot", status
        # The DDS port of the domain's discovery (DDSI-RTPS 9.6.1.1).
        ports = {line.split()[1].rsplit(":")[1] for line in Path(f"/proc/{node.pid}/net/udp").read_text().splitlines()[1:]}
        assert f"{7400 + 250 * int(DOMAIN):04X}" in ports, ports
        node.send_signal(signal.SIGINT)
        assert node.wait(NODE_MAX_S) == 0, (folder / "sgc.log").read_text()
    finally:
        node.kill()


def main() -> None:
    launch_stand_in.install()
    with tempfile.TemporaryDirectory() as folder:
        share = build(Path(folder))
        launch_file = share / "launch/proxy.launch.py"
        check_arguments(launch_file)
        run_node(Path(sys.argv[1]).resolve(), launch_file, Path(folder))
    print("sgc_ros is built, and a node runs as its launch file says; ROS's own `launch` was NOT there to try")


if __name__ == "__main__":
    main()
