#!/usr/bin/env bash
# Builds the ROS package dist/ros/sgc_ros with colcon, and starts a node as its launch file says.
#   ros-package.sh [SGC]   the program, by default that of the debug build
# colcon is on PyPI and goes into .tools/colcon.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

sgc=${1:-${CARGO_TARGET_DIR:-target}/debug/sgc}
[ -x "$sgc" ] || die "$sgc is missing: run \`cargo build -p sgc\` first, or name another build"
python_tool colcon tests/dist/ros/requirements.txt
exec "$tool/bin/python" -B tests/dist/ros/check.py "$sgc"
