"""Uses ROS 2 topics, services and actions without ROS, through a gateway of SGC.

    import sgc

    with sgc.connect("grpc://127.0.0.1:50051") as robot:
        for odom in robot.subscribe("/odom", rate=5):
            print(odom.pose.pose.position.x)

Messages are :class:`Message`: dictionaries whose members are attributes, too. Arrays of bytes are ``bytes``. Arrays of
other numbers are ``array.array``, which numpy uses without a copy. A failure raises :class:`GatewayError`.
"""

from ._client import (
    ActionGoal,
    Client,
    Endpoint,
    GatewayError,
    Goal,
    Graph,
    Node,
    Outcome,
    Publisher,
    Qos,
    Service,
    Serving,
    Subscription,
    Topic,
    TypeDefinition,
    connect,
)
from ._message import Info, Message, info

__all__ = [
    "ActionGoal",
    "Client",
    "Endpoint",
    "GatewayError",
    "Goal",
    "Graph",
    "Info",
    "Message",
    "Node",
    "Outcome",
    "Publisher",
    "Qos",
    "Service",
    "Serving",
    "Subscription",
    "Topic",
    "TypeDefinition",
    "connect",
    "info",
]
