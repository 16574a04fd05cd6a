"""Runs `sgc run` beside the nodes of a robot.

    ros2 launch sgc_ros proxy.launch.py config:=/etc/sgc/robot.toml
"""

import shlex

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

# Name, default and meaning of each argument.
ARGUMENTS = (
    ("config", "", "Configuration of the node (sgc.toml). Empty: `args` say everything."),
    ("domain", "", "ROS_DOMAIN_ID for the node, unless `domain_id` in [ros] gives one. Empty: that of the environment."),
    ("args", "", "Further arguments of `sgc run`, quoted as for a shell."),
    ("program", "sgc", "The program, by its path or by its name in PATH."),
    ("respawn", "false", "true: starts the node again 5 s after it ended."),
)
RESPAWN_DELAY_S = 5.0


def start(context):
    """Return the process, for the arguments as they are now."""
    config, domain, args, program, respawn = (
        LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS
    )
    if respawn not in ("true", "false"):
        raise ValueError(f"respawn is true or false, and not {respawn!r}")
    command = [program, "run", *(["--config", config] if config else []), *shlex.split(args)]
    return [
        ExecuteProcess(
            name="sgc",
            cmd=command,
            additional_env={"ROS_DOMAIN_ID": domain} if domain else None,
            output="screen",
            respawn=respawn == "true",
            respawn_delay=RESPAWN_DELAY_S,
        )
    ]


def generate_launch_description():
    """Return the description for `ros2 launch`."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning) for name, default, meaning in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
