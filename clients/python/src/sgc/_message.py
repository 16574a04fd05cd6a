"""Messages, which are dictionaries whose members are attributes, too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Optional


@dataclass(frozen=True)
class Info:
    """The origin and the times of a message."""

    source_time_ns: int
    """Time of publication by the publisher's clock, in nanoseconds since 1970."""
    received_time_ns: int
    """Time of arrival at the gateway by its clock, in nanoseconds since 1970."""
    node: str
    """Full name of the publishing node; empty if the network does not announce it."""
    dropped: int
    """Number of messages dropped so far because this program reads too slowly."""


class Message(dict):  # type: ignore[type-arg]
    """A message: ``message.pose.position.x`` is ``message["pose"]["position"]["x"]``.

    Members take precedence over methods of dictionaries: ``message.values`` is the member ``values``, if there is one.
    """

    __slots__ = ("_sgc_info",)
    _sgc_info: Info

    def __getattribute__(self, name: str) -> Any:
        try:
            return dict.__getitem__(self, name)
        except KeyError:
            return dict.__getattribute__(self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "_sgc_info":
            dict.__setattr__(self, name, value)
        else:
            self[name] = value

    def __repr__(self) -> str:
        members = ", ".join(f"{name}={value!r}" for name, value in dict.items(self))
        return f"Message({members})"


def info(message: Message) -> Optional[Info]:
    """Returns the origin of a message of a topic; ``None`` for any other message, and for parts of one."""
    return getattr(message, "_sgc_info", None)
