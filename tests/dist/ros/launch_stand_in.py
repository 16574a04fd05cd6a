"""A stand-in for those parts of ROS 2's `launch` that proxy.launch.py uses.

The library is neither on PyPI nor in Debian. Names and keyword arguments are those of Jazzy; anything else is an error.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Callable


class LaunchContext:
    """The values of the arguments."""

    def __init__(self, given: dict[str, str]) -> None:
        self.launch_configurations = dict(given)


@dataclass
class LaunchDescription:
    """Actions in order."""

    entities: list

    def visit(self, context: LaunchContext) -> list["ExecuteProcess"]:
        """Returns the processes that the launch starts."""
        started = []
        for entity in self.entities:
            if isinstance(entity, DeclareLaunchArgument):
                context.launch_configurations.setdefault(entity.name, entity.default_value)
            elif isinstance(entity, OpaqueFunction):
                started += entity.function(context)
            else:
                raise TypeError(entity)
        return started


class DeclareLaunchArgument:
    def __init__(self, name: str, *, default_value: str, description: str) -> None:
        self.name, self.default_value, self.description = name, default_value, description


class OpaqueFunction:
    def __init__(self, *, function: Callable) -> None:
        self.function = function


class ExecuteProcess:
    def __init__(
        self,
        *,
        cmd: list[str],
        name: str | None = None,
        additional_env: dict[str, str] | None = None,
        output: str = "log",
        respawn: bool = False,
        respawn_delay: float | None = None,
    ) -> None:
        self.cmd, self.name, self.additional_env, self.output = cmd, name, additional_env, output
        self.respawn, self.respawn_delay = respawn, respawn_delay


class LaunchConfiguration:
    def __init__(self, variable_name: str) -> None:
        self.variable_name = variable_name

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.variable_name]


def install() -> None:
    """Makes `import launch` find these."""
    for module, names in {
        "launch": [LaunchDescription, LaunchContext],
        "launch.actions": [DeclareLaunchArgument, ExecuteProcess, OpaqueFunction],
        "launch.substitutions": [LaunchConfiguration],
    }.items():
        made = ModuleType(module)
        for each in names:
            setattr(made, each.__name__, each)
        sys.modules[module] = made
