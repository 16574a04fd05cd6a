"""PyPI's roslibpy against a gateway: its documented examples, and other behaviour that its users rely on.

python rosbridge.py PORT; "all is well" and an exit code of 0 if all was right. ROSLIBPY_TRANSPORT says by which of its transports.
"""

import os
import sys
import threading

import roslibpy
from roslibpy.ros2 import Header

PATIENCE = 20


class Heard:
    """Records the arguments of a callback."""

    def __init__(self):
        self.all = []
        self.changed = threading.Condition()

    def __call__(self, what):
        with self.changed:
            self.all.append(what)
            self.changed.notify_all()

    def wait(self, count=1):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.all) >= count, PATIENCE), self.all
            return self.all[count - 1]


def topics(ros, other):
    listener = roslibpy.Topic(ros, "/chatter", "std_msgs/String")
    heard = Heard()
    listener.subscribe(heard)
    assert heard.wait(3)["data"].startswith("hello ")
    listener.unsubscribe()

    # The first message of a new publisher arrives, and every one after it.
    echo = roslibpy.Topic(other, "/py/echo", "std_msgs/String", throttle_rate=0, queue_length=100)
    heard = Heard()
    echo.subscribe(heard)
    other.get_topics()
    talker = roslibpy.Topic(ros, "/py/echo", "std_msgs/String")
    for number in range(20):
        talker.publish(roslibpy.Message({"data": "Hello World %d!" % number}))
    assert heard.wait(20)["data"] == "Hello World 19!"
    assert len(heard.all) == 20
    talker.unadvertise()
    echo.unsubscribe()

    # Times are those of ROS 1; a header without one is stamped now.
    points = Heard()
    listener = roslibpy.Topic(other, "/py/points", "geometry_msgs/PointStamped")
    listener.subscribe(points)
    other.get_topics()
    publisher = roslibpy.Topic(ros, "/py/points", "geometry_msgs/PointStamped")
    for stamp in [roslibpy.Time(3, 4), None]:
        header = Header(stamp=stamp, frame_id="base")
        publisher.publish(roslibpy.Message(dict(header=dict(header), point=dict(x=0.0, y=1.0, z=2.0))))
    assert points.wait(1)["header"]["stamp"] == {"sec": 3, "nanosec": 4}
    assert points.wait(2)["header"]["stamp"]["sec"] > 1_500_000_000
    assert points.wait(2)["point"] == {"x": 0.0, "y": 1.0, "z": 2.0}


def services(ros, other):
    service = roslibpy.Service(ros, "/switch", "std_srvs/SetBool")
    assert service.call(roslibpy.ServiceRequest({"data": True}), timeout=PATIENCE)["message"] == "on"
    answered, refused = Heard(), Heard()
    service.call(roslibpy.ServiceRequest({"data": False}), answered, refused)
    assert answered.wait()["message"] == "off"
    service.call(roslibpy.ServiceRequest({"wrong": 1}), answered, refused)
    assert "wrong" in refused.wait()
    try:
        service.call(roslibpy.ServiceRequest({"wrong": 1}), timeout=PATIENCE)
        raise AssertionError("it should have been refused")
    except Exception as error:
        assert "wrong" in str(error), error

    def handler(request, response):
        response["success"] = True
        response["message"] = "ludicrous" if request["data"] else "not"
        return True

    served = roslibpy.Service(ros, "/py/speed", "std_srvs/SetBool")
    served.advertise(handler)
    ros.get_services()
    asked = roslibpy.Service(other, "/py/speed", "std_srvs/SetBool")
    assert asked.call(roslibpy.ServiceRequest({"data": True}), timeout=PATIENCE)["message"] == "ludicrous"
    served.unadvertise()


def introspection(ros):
    assert "/chatter" in ros.get_topics()
    assert ros.get_topic_type("/chatter") == "std_msgs/msg/String"
    assert "/chatter" in ros.get_topics_for_type("std_msgs/msg/String")
    assert "/switch" in ros.get_services()
    assert ros.get_service_type("/switch") == "std_srvs/srv/SetBool"
    assert ros.get_services_for_type("std_srvs/srv/SetBool") == ["/switch"]
    assert ros.get_service_request_details("std_srvs/SetBool")["typedefs"][0]["fieldnames"] == ["data"]
    assert ros.get_service_response_details("std_srvs/SetBool")["typedefs"][0]["fieldtypes"] == ["boolean", "string"]
    details = ros.get_message_details("geometry_msgs/Twist")["typedefs"]
    assert [of["type"] for of in details] == ["geometry_msgs/Twist", "geometry_msgs/Vector3"]
    assert "/sgc_gateway" in ros.get_nodes()
    assert "/switch" in ros.get_node_details("/sgc_gateway")["services"]
    assert ros.get_time().to_sec() > 1_500_000_000
    servers = Heard()
    ros.get_action_servers(servers)
    assert "/fibonacci" in servers.wait()["action_servers"]

    assert ros.get_params() == ["/arm:speed"]
    assert ros.get_param("/arm:speed") == 0.5
    ros.set_param("/arm:speed", 2)
    assert ros.get_param("/arm:speed") == 2.0
    ros.set_param("/arm:speed", 0.5)
    ros.set_param("/arm:other", [1, 2])
    assert ros.get_param("/arm:other") == [1, 2]
    ros.delete_param("/arm:other")
    assert ros.get_param("/arm:other") is None


def actions(ros):
    client = roslibpy.ActionClient(ros, "/fibonacci", "example_interfaces/action/Fibonacci")
    result, feedback, failed = Heard(), Heard(), Heard()
    client.wait_goal(client.send_goal(roslibpy.Goal({"order": 8}), result, feedback, failed), PATIENCE)
    assert result.wait()["status"] == roslibpy.GoalStatus.SUCCEEDED
    assert result.wait()["values"]["sequence"] == [0, 1, 1, 2, 3, 5, 8, 13, 21]
    assert feedback.wait(7)["sequence"][-1] == 21
    result, feedback = Heard(), Heard()
    goal = client.send_goal(roslibpy.Goal({"order": 10}), result, feedback, failed)
    feedback.wait()
    client.cancel_goal(goal)
    client.wait_goal(goal, PATIENCE)
    assert result.wait()["status"] == roslibpy.GoalStatus.CANCELED
    nobody = roslibpy.ActionClient(ros, "/nobody", "example_interfaces/action/Fibonacci")
    nobody.send_goal(roslibpy.Goal({"order": 1}), result, feedback, failed)
    assert "nobody serves" in failed.wait()["values"]


def main():
    ros, other = (roslibpy.Ros("127.0.0.1", int(sys.argv[1])) for _ in range(2))
    for client in [ros, other]:
        client.run(timeout=PATIENCE)
    topics(ros, other)
    services(ros, other)
    introspection(ros)
    actions(ros)
    for client in [ros, other]:
        client.close()
    print("all is well", flush=True)
    os._exit(0)


main()
