#!/usr/bin/env python3
"""Writes crates/sgc-cdr/src/common.txt: the definitions of the common ROS 2 interfaces, without their comments. Messages are
taken from the type stores of PyPI's `rosbags`, which has them from the repositories of ROS 2 (Jazzy; Kilted for what is newer);
services and actions, which it does not have, are below."""

import pathlib

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

OUT = pathlib.Path(__file__).resolve().parent.parent / "crates" / "sgc-cdr" / "src" / "common.txt"

OTHERS = {
    "action_msgs/srv/CancelGoal": """
        action_msgs/GoalInfo goal_info
        ---
        int8 ERROR_NONE=0
        int8 ERROR_REJECTED=1
        int8 ERROR_UNKNOWN_GOAL_ID=2
        int8 ERROR_GOAL_TERMINATED=3
        int8 return_code
        action_msgs/GoalInfo[] goals_canceling""",
    "diagnostic_msgs/srv/AddDiagnostics": "string load_namespace\n---\nbool success\nstring message",
    "diagnostic_msgs/srv/SelfTest": "---\nstring id\nbyte passed\ndiagnostic_msgs/DiagnosticStatus[] status",
    "example_interfaces/action/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence",
    "example_interfaces/msg/WString": "wstring data",
    "example_interfaces/srv/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum",
    "example_interfaces/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "example_interfaces/srv/Trigger": "---\nbool success\nstring message",
    "lifecycle_msgs/srv/ChangeState": "lifecycle_msgs/Transition transition\n---\nbool success",
    "lifecycle_msgs/srv/GetAvailableStates": "---\nlifecycle_msgs/State[] available_states",
    "lifecycle_msgs/srv/GetAvailableTransitions": "---\nlifecycle_msgs/TransitionDescription[] available_transitions",
    "lifecycle_msgs/srv/GetState": "---\nlifecycle_msgs/State current_state",
    "nav_msgs/srv/GetMap": "---\nnav_msgs/OccupancyGrid map",
    "nav_msgs/srv/GetPlan": """
        geometry_msgs/PoseStamped start
        geometry_msgs/PoseStamped goal
        float32 tolerance
        ---
        nav_msgs/Path plan""",
    "nav_msgs/srv/LoadMap": """
        string map_url
        ---
        uint8 RESULT_SUCCESS=0
        uint8 RESULT_MAP_DOES_NOT_EXIST=1
        uint8 RESULT_INVALID_MAP_DATA=2
        uint8 RESULT_INVALID_MAP_METADATA=3
        uint8 RESULT_UNDEFINED_FAILURE=255
        nav_msgs/OccupancyGrid map
        uint8 result""",
    "nav_msgs/srv/SetMap": """
        nav_msgs/OccupancyGrid map
        geometry_msgs/PoseWithCovarianceStamped initial_pose
        ---
        bool success""",
    "rcl_interfaces/srv/DescribeParameters": "string[] names\n---\nrcl_interfaces/ParameterDescriptor[] descriptors",
    "rcl_interfaces/srv/GetLoggerLevels": "string[] names\n---\nrcl_interfaces/LoggerLevel[] levels",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values",
    "rcl_interfaces/srv/ListParameters": """
        uint64 DEPTH_RECURSIVE=0
        string[] prefixes
        uint64 depth
        ---
        rcl_interfaces/ListParametersResult result""",
    "rcl_interfaces/srv/SetLoggerLevels":
        "rcl_interfaces/LoggerLevel[] levels\n---\nrcl_interfaces/SetLoggerLevelsResult[] results",
    "rcl_interfaces/srv/SetParameters":
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult[] results",
    "rcl_interfaces/srv/SetParametersAtomically":
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult result",
    "sensor_msgs/srv/SetCameraInfo": "sensor_msgs/CameraInfo camera_info\n---\nbool success\nstring status_message",
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    "tf2_msgs/action/LookupTransform": """
        string target_frame
        string source_frame
        builtin_interfaces/Time source_time
        builtin_interfaces/Duration timeout
        builtin_interfaces/Time target_time
        string fixed_frame
        bool advanced
        ---
        geometry_msgs/TransformStamped transform
        tf2_msgs/TF2Error error
        ---""",
    "tf2_msgs/srv/FrameGraph": "---\nstring frame_yaml",
    "type_description_interfaces/srv/GetTypeDescription": """
        string type_name
        string type_hash
        bool include_type_sources true
        ---
        bool successful
        string failure_reason
        type_description_interfaces/TypeDescription type_description
        type_description_interfaces/TypeSource[] type_sources
        type_description_interfaces/KeyValue[] extra_information""",
    "visualization_msgs/srv/GetInteractiveMarkers":
        "---\nuint64 sequence_number\nvisualization_msgs/InteractiveMarker[] markers",
}

# Defaults, which `rosbags` does not keep.
DEFAULTS = {
    ("geometry_msgs/msg/Quaternion", "x"): "0",
    ("geometry_msgs/msg/Quaternion", "y"): "0",
    ("geometry_msgs/msg/Quaternion", "z"): "0",
    ("geometry_msgs/msg/Quaternion", "w"): "1",
}

# Is to `std_msgs` what a copy is.
COPIED = "example_interfaces"
NOT_COPIED = {"Header", "ColorRGBA"}


def spelt(desc) -> str:
    kind, rest = desc
    if kind == Nodetype.BASE:
        name, bound = rest
        return f"{name}<={bound}" if bound else name
    if kind == Nodetype.NAME:
        return rest.replace("/msg/", "/")
    inner, count = rest
    if kind == Nodetype.ARRAY:
        return f"{spelt(inner)}[{count}]"
    return f"{spelt(inner)}[<={count}]" if count else f"{spelt(inner)}[]"


def body(name: str, definition) -> str:
    constants, fields = definition
    lines = []
    for constant, kind, value in constants:
        lines.append(f'{kind} {constant}="{value}"' if kind == "string" else f"{kind} {constant}={value}")
    for field, desc in fields:
        if field == "structure_needs_at_least_one_member":
            continue
        default = DEFAULTS.get((name, field))
        lines.append(f"{spelt(desc)} {field}" + (f" {default}" if default else ""))
    return "".join(line + "\n" for line in lines)


def main() -> None:
    files = {}
    for store in (Stores.ROS2_KILTED, Stores.ROS2_JAZZY):
        for name, definition in get_typestore(store).fielddefs.items():
            if not name.startswith("rosbag2_interfaces/"):
                files[name] = body(name, definition)
    for name, text in list(files.items()):
        package, _, short = name.split("/")
        if package == "std_msgs" and short not in NOT_COPIED:
            files[f"{COPIED}/msg/{short}"] = text.replace("std_msgs/", f"{COPIED}/")
    for name, text in OTHERS.items():
        files[name] = "".join(line.strip() + "\n" for line in text.strip().splitlines())
    OUT.write_text("".join(f"== {name}\n{files[name]}" for name in sorted(files)))
    print(f"{len(files)} interfaces, {OUT.stat().st_size} bytes")


main()
