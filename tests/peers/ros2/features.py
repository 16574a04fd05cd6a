"""Features of ROS 2 beyond topics and calls: lifecycles, simulated time, service introspection, transforms, images (../README.md).
"""

import argparse
import faulthandler
import json
import signal
import struct
import sys
import threading
import time
import zlib

import rclpy
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from retyped import retyped

EVENTS = ["REQUEST_SENT", "REQUEST_RECEIVED", "RESPONSE_SENT", "RESPONSE_RECEIVED"]


def say(event: str, **facts: object) -> None:
    print(json.dumps({"event": event, **facts}), flush=True)


def matched(status) -> None:
    say("matched", count=status.current_count)


def lines(act) -> None:
    """Calls a function at each line of standard input."""
    threading.Thread(target=lambda: [act() for _ in sys.stdin], daemon=True).start()


class Camera(LifecycleNode):
    """A node with a lifecycle, which publishes while it is active."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("camera", namespace=options.namespace)
        self.status = self.create_lifecycle_publisher(String, "~/status", 10)
        self.watchers = 0
        self.create_timer(0.05, self.tick)

    def tick(self) -> None:
        self.status.publish(String(data="active"))
        # The publisher of a lifecycle has no callback for it.
        watchers = self.count_subscribers("~/transition_event")
        if watchers != self.watchers:
            self.watchers = watchers
            say("matched", count=watchers)

    def on_configure(self, state) -> TransitionCallbackReturn:
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state) -> TransitionCallbackReturn:
        super().on_activate(state)
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state) -> TransitionCallbackReturn:
        # A node that cannot clean up goes through its error state.
        return TransitionCallbackReturn.ERROR

    def on_error(self, state) -> TransitionCallbackReturn:
        return TransitionCallbackReturn.SUCCESS


class Manager(Node):
    """Leads a camera through its lifecycle at a line of standard input, and reports its states, answers and events."""

    STEPS = [
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    ]

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("manager")
        name = f"{options.namespace}/camera"
        self.events: list[str] = []
        self.heard = threading.Event()
        self.is_over = threading.Event()
        self.create_subscription(TransitionEvent, f"{name}/transition_event", self.note, 100)
        self.create_subscription(String, f"{name}/status", lambda _: self.heard.set(), 10)
        self.change = self.create_client(ChangeState, f"{name}/change_state")
        self.state = self.create_client(GetState, f"{name}/get_state")
        self.list = self.create_client(GetAvailableTransitions, f"{name}/get_available_transitions")
        lines(self.manage)

    def note(self, event: TransitionEvent) -> None:
        self.events.append(f"{event.start_state.label}-{event.goal_state.label}")
        if event.goal_state.label == "finalized":
            self.is_over.set()

    def call(self, client, request) -> object:
        client.wait_for_service()
        future = client.call_async(request)
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        return future.result() if done.wait(20) else None

    def manage(self) -> None:
        steps = []
        topic = self.events_topic()
        while self.count_publishers(topic) == 0:
            time.sleep(0.02)
        for step in self.STEPS:
            change = ChangeState.Request(transition=Transition(id=step))
            answer = self.call(self.change, change)
            state = self.call(self.state, GetState.Request())
            more = self.call(self.list, GetAvailableTransitions.Request())
            steps.append(
                [
                    answer and answer.success,
                    state and state.current_state.label,
                    more and sorted(one.transition.label for one in more.available_transitions),
                ]
            )
            if step == Transition.TRANSITION_ACTIVATE:
                steps.append(["heard", self.heard.wait(20)])
        self.is_over.wait(20)
        say("managed", steps=steps, events=self.events)

    def events_topic(self) -> str:
        return self.change.srv_name.replace("change_state", "transition_event")


class Simulator(Node):
    """Publishes a time that runs ten times as fast; each line begins it anew."""

    RATE_HZ = 100
    STEP_NS = 100_000_000
    BEGIN_NS = 1_000 * 10**9

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("simulator")
        self.now_ns = self.BEGIN_NS
        self.clock = self.create_publisher(Clock, "/clock", 10)
        self.create_timer(1 / self.RATE_HZ, self.tick)
        lines(self.begin)

    def begin(self) -> None:
        self.now_ns = self.BEGIN_NS

    def tick(self) -> None:
        self.now_ns += self.STEP_NS
        clock = Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(self.now_ns, 10**9)
        self.clock.publish(clock)


class Simulated(Node):
    """Runs a node on simulated time."""

    def __init__(self, options: argparse.Namespace) -> None:
        use_sim_time = Parameter("use_sim_time", Parameter.Type.BOOL, True)
        super().__init__("simulated", parameter_overrides=[use_sim_time])
        # Clocks hold these weakly.
        self.jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=lambda jump: say("jumped", seconds=jump.delta.nanoseconds / 1e9),
        )
        self.create_timer(1.0, lambda: say("tick", seconds=self.get_clock().now().nanoseconds / 1e9))



class Server(Node):
    """Serves a service and publishes its introspection events."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("server")
        service = self.create_service(SetBool, options.topic, self.answer)
        service.configure_introspection(
            self.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS
        )

    def answer(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = not request.data, "done"
        return response


class Client(Node):
    """Calls a service at each line and publishes the introspection events."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("client")
        self.client = self.create_client(SetBool, options.topic)
        self.client.configure_introspection(
            self.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS
        )
        lines(self.call)

    def call(self) -> None:
        self.client.wait_for_service()
        future = self.client.call_async(SetBool.Request(data=True))
        future.add_done_callback(lambda future: say("answer", success=future.result().success))


class Watcher(Node):
    """Reports the introspection events of a service."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("watcher")
        # The events of a call come at once.
        self.create_subscription(
            SetBool.Impl.Event if hasattr(SetBool, "Impl") else SetBool.Event,
            f"{options.topic}/_service_event",
            self.hear,
            QoSProfile(depth=100),
        )

    def hear(self, event) -> None:
        say(
            "service_event",
            kind=EVENTS[event.info.event_type],
            client=bytes(event.info.client_gid).hex(),
            number=event.info.sequence_number,
            request=[one.data for one in event.request],
            response=[[one.success, one.message] for one in event.response],
        )


def transforms(of: list[tuple[str, str, float]]) -> bytes:
    """Returns a tf2_msgs/TFMessage as little-endian CDR."""
    cdr = struct.pack("<I", len(of))

    def text(cdr: bytes, of: str) -> bytes:
        cdr += bytes(-len(cdr) % 4)
        return cdr + struct.pack("<I", len(of) + 1) + of.encode() + b"\0"

    for parent, child, x in of:
        cdr += bytes(-len(cdr) % 4) + struct.pack("<iI", 17, 23)
        cdr = text(text(cdr, parent), child)
        cdr += bytes(-len(cdr) % 8) + struct.pack("<7d", x, 2, 3, 0, 0, 0, 1)
    return b"\0\1\0\0" + cdr


def frames(cdr: bytes) -> list[list[object]]:
    """Returns the frames of a TFMessage, and how far the one is from the other along x."""
    body, at, found = cdr[4:], 4, []

    def text() -> str:
        nonlocal at
        at += -at % 4
        (length,) = struct.unpack_from("<I", body, at)
        at += 4 + length
        return body[at - length : at - 1].decode()

    for _ in range(struct.unpack_from("<I", body)[0]):
        at += -at % 4 + 8
        parent, child = text(), text()
        at += -at % 8
        found.append([parent, child, *struct.unpack_from("<7d", body, at)[:1]])
        at += 56
    return found


def tf_message() -> type:
    # The layout does not matter, because messages pass as CDR.
    return retyped(String, package="tf2_msgs", name="TFMessage")


class Broadcaster(Node):
    """Publishes transforms."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("broadcaster")
        self.tf = self.create_publisher(tf_message(), options.topic, 100)
        what = transforms([("map", "odom", 1), ("/odom", "base_link", 0.5), ("base_link", "", -2)])
        self.create_timer(0.05, lambda: self.tf.publish(what))


class Listener(Node):
    """Reports received frames."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("listener")
        self.create_subscription(
            tf_message(), options.topic, lambda cdr: say("frames", frames=frames(cdr)), 100, raw=True
        )


class Other(Node):
    """Publishes, or hears, a version of std_msgs/String with another definition."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("other")
        kind = retyped(String, other_hash=True)
        if options.hears:
            self.create_subscription(kind, options.topic, lambda _: say("received"), 10, raw=True)
            return
        text = b"7"
        cdr = b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text + b"\0"
        self.publisher = self.create_publisher(kind, options.topic, 10)
        self.create_timer(0.05, lambda: self.publisher.publish(cdr))


class ImagePublisher(Node):
    """Publishes an image at each line."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("images")
        callbacks = PublisherEventCallbacks(matched=matched)
        self.publisher = self.create_publisher(Image, options.topic, 10, event_callbacks=callbacks)
        self.count = 0
        lines(lambda: self.publish(options.sizes[self.count % len(options.sizes)]))

    def publish(self, size: int) -> None:
        self.count += 1
        image = Image(height=size // 1000, width=1000, encoding="mono8", step=1000)
        image.header.frame_id = str(self.count)
        image.data.frombytes(bytes((i * self.count) % 251 for i in range(1000)) * (size // 1000))
        self.publisher.publish(image)
        say("sent", crc=zlib.crc32(image.data), size=len(image.data), seq=self.count)


class ImageSubscriber(Node):
    """Reports received images."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("viewer")
        callbacks = SubscriptionEventCallbacks(matched=matched)
        self.create_subscription(Image, options.topic, self.hear, 10, event_callbacks=callbacks)

    def hear(self, image: Image) -> None:
        is_whole = image.height * image.step == len(image.data) and image.encoding == "mono8"
        say(
            "received",
            crc=zlib.crc32(image.data),
            size=len(image.data),
            seq=int(image.header.frame_id),
            whole=is_whole,
        )


ROLES = {
    "camera": Camera,
    "manage": Manager,
    "simulator": Simulator,
    "simulated": Simulated,
    "serve": Server,
    "call": Client,
    "watch": Watcher,
    "broadcast": Broadcaster,
    "frames": Listener,
    "other": Other,
    "image-pub": ImagePublisher,
    "image-sub": ImageSubscriber,
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=ROLES)
    parser.add_argument("--topic", default="/feature", help="or the service")
    parser.add_argument("--namespace", default="/robot", help="of the camera")
    parser.add_argument("--hears", action="store_true", help="`other` subscribes")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1_000_000], help="of images in bytes, whole thousands")
    options = parser.parse_args()
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = ROLES[options.role](options)
    say("ready")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.1)
    # A library that does not let go is named in the log of a test that waits for the summary.
    faulthandler.dump_traceback_later(60)
    # Lets others know at once that the node is gone.
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()
    say("summary")


if __name__ == "__main__":
    main()
