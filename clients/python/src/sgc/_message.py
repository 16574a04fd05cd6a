"""Messages: dictionaries whose members are attributes, too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Optional


@dataclass(frozen=True)
class Info:
    """How a message came."""

    source_time_ns: int
    """When it was published, by the publisher's clock, nanoseconds since 1970."""
    received_time_ns: int
    """When it came to the gateway, by its clock, nanoseconds since 1970."""
    node: str
    """Full name of the node that published it; empty if the network does not tell."""
    dropped: int
    """How many messages were left out until now, since this program took them too slowly."""


class Message(dict):  # type: ignore[type-arg]
    """A message: ``message.pose.position.x`` is ``message["pose"]["position"]["x"]``.

    Members come before what dictionaries have themselves: ``message.values`` is the member of that name, if there is one.
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
    """How a message came that was heard on a topic; ``None`` of any other, and of parts of it."""
    return getattr(message, "_sgc_info", None)
