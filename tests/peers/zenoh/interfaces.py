"""The ROS 2 interfaces of the peer: their fields, and the hashes that are part of their keys.

Hashes of standard packages are those in `share/PACKAGE/*/NAME.json` of ROS 2 Jazzy. Those of `example_interfaces`, which PyPI
does not have, were computed from the same files by the rule of REP 2016, with the names and fields of that package. `check.py`
compares them.
"""

from cdr import Codec

MESSAGES = {
    "std_msgs/String": {"data": "string"},
    "std_msgs/MultiArrayDimension": {"label": "string", "size": "uint32", "stride": "uint32"},
    "std_msgs/MultiArrayLayout": {"dim": "sequence<std_msgs/MultiArrayDimension>", "data_offset": "uint32"},
    "std_msgs/UInt8MultiArray": {"layout": "std_msgs/MultiArrayLayout", "data": "sequence<uint8>"},
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "unique_identifier_msgs/UUID": {"uuid": "uint8[16]"},
    "action_msgs/GoalInfo": {"goal_id": "unique_identifier_msgs/UUID", "stamp": "builtin_interfaces/Time"},
    "action_msgs/GoalStatus": {"goal_info": "action_msgs/GoalInfo", "status": "int8"},
    "action_msgs/GoalStatusArray": {"status_list": "sequence<action_msgs/GoalStatus>"},
    "rcl_interfaces/ParameterValue": {
        "type": "uint8",
        "bool_value": "boolean",
        "integer_value": "int64",
        "double_value": "double",
        "string_value": "string",
        "byte_array_value": "sequence<octet>",
        "bool_array_value": "sequence<boolean>",
        "integer_array_value": "sequence<int64>",
        "double_array_value": "sequence<double>",
        "string_array_value": "sequence<string>",
    },
    "rcl_interfaces/Parameter": {"name": "string", "value": "rcl_interfaces/ParameterValue"},
    "rcl_interfaces/ParameterEvent": {
        "stamp": "builtin_interfaces/Time",
        "node": "string",
        "new_parameters": "sequence<rcl_interfaces/Parameter>",
        "changed_parameters": "sequence<rcl_interfaces/Parameter>",
        "deleted_parameters": "sequence<rcl_interfaces/Parameter>",
    },
    "rcl_interfaces/FloatingPointRange": {"from_value": "double", "to_value": "double", "step": "double"},
    "rcl_interfaces/IntegerRange": {"from_value": "int64", "to_value": "int64", "step": "uint64"},
    "rcl_interfaces/ParameterDescriptor": {
        "name": "string",
        "type": "uint8",
        "description": "string",
        "additional_constraints": "string",
        "read_only": "boolean",
        "dynamic_typing": "boolean",
        "floating_point_range": "sequence<rcl_interfaces/FloatingPointRange, 1>",
        "integer_range": "sequence<rcl_interfaces/IntegerRange, 1>",
    },
    "rcl_interfaces/ListParametersResult": {"names": "sequence<string>", "prefixes": "sequence<string>"},
    "rcl_interfaces/SetParametersResult": {"successful": "boolean", "reason": "string"},
}

BASIC = {
    "bool_value": "boolean",
    "byte_value": "octet",
    "char_value": "uint8",
    "float32_value": "float",
    "float64_value": "double",
    "int8_value": "int8",
    "uint8_value": "uint8",
    "int16_value": "int16",
    "uint16_value": "uint16",
    "int32_value": "int32",
    "uint32_value": "uint32",
    "int64_value": "int64",
    "uint64_value": "uint64",
    "string_value": "string",
}
NAMES = {"names": "sequence<string>"}
PARAMETERS = {"parameters": "sequence<rcl_interfaces/Parameter>"}

# Requests and replies.
SERVICES: dict[str, tuple[dict, dict]] = {
    "example_interfaces/srv/AddTwoInts": ({"a": "int64", "b": "int64"}, {"sum": "int64"}),
    "test_msgs/srv/BasicTypes": (BASIC, BASIC),
    "std_srvs/srv/Trigger": ({}, {"success": "boolean", "message": "string"}),
    "action_msgs/srv/CancelGoal": (
        {"goal_info": "action_msgs/GoalInfo"},
        {"return_code": "int8", "goals_canceling": "sequence<action_msgs/GoalInfo>"},
    ),
    "rcl_interfaces/srv/DescribeParameters": (NAMES, {"descriptors": "sequence<rcl_interfaces/ParameterDescriptor>"}),
    "rcl_interfaces/srv/GetParameterTypes": (NAMES, {"types": "sequence<uint8>"}),
    "rcl_interfaces/srv/GetParameters": (NAMES, {"values": "sequence<rcl_interfaces/ParameterValue>"}),
    "rcl_interfaces/srv/ListParameters": (
        {"prefixes": "sequence<string>", "depth": "uint64"},
        {"result": "rcl_interfaces/ListParametersResult"},
    ),
    "rcl_interfaces/srv/SetParameters": (PARAMETERS, {"results": "sequence<rcl_interfaces/SetParametersResult>"}),
    "rcl_interfaces/srv/SetParametersAtomically": (PARAMETERS, {"result": "rcl_interfaces/SetParametersResult"}),
}

# The packages that have the action Fibonacci, with equal fields.
FIBONACCI_OF = ("example_interfaces", "test_msgs")
for package in FIBONACCI_OF:
    SERVICES[f"{package}/action/Fibonacci_SendGoal"] = (
        {"goal_id": "unique_identifier_msgs/UUID", "order": "int32"},
        {"accepted": "boolean", "stamp": "builtin_interfaces/Time"},
    )
    SERVICES[f"{package}/action/Fibonacci_GetResult"] = (
        {"goal_id": "unique_identifier_msgs/UUID"},
        {"status": "int8", "sequence": "sequence<int32>"},
    )
    MESSAGES[f"{package}/action/Fibonacci_FeedbackMessage"] = {
        "goal_id": "unique_identifier_msgs/UUID",
        "sequence": "sequence<int32>",
    }

HASHES = {
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_msgs/msg/UInt8MultiArray": "RIHS01_5687e861b8d307a5e48b7515467ae7a5fc2daf805bd0ce6d8e9e604bade9f385",
    "example_interfaces/srv/AddTwoInts": "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "test_msgs/srv/BasicTypes": "RIHS01_da348697437c103cc9a9322ac1bdbdcf8eb11a85de22f7f2492ca1df416e1a5f",
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "action_msgs/srv/CancelGoal": "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    "action_msgs/msg/GoalStatusArray": "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
    "example_interfaces/action/Fibonacci_SendGoal": "RIHS01_d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    "example_interfaces/action/Fibonacci_GetResult": "RIHS01_1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
    "example_interfaces/action/Fibonacci_FeedbackMessage": "RIHS01_c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
    "test_msgs/action/Fibonacci_SendGoal": "RIHS01_d807633803e38e164276573cd97e9fbd71e109c290bbf4cc312a0a1c9da7bbd9",
    "test_msgs/action/Fibonacci_GetResult": "RIHS01_5d30fdeb21d20e117aa5f36c7b4f0b6874f1a8cf7a9c038d58f1156c5737b209",
    "test_msgs/action/Fibonacci_FeedbackMessage": "RIHS01_37487bae8cea358366b97003c1ef1ca7ce7c08df36f9e8cca496624226aee64e",
    "rcl_interfaces/msg/ParameterEvent": "RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
    "rcl_interfaces/srv/DescribeParameters": "RIHS01_845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
    "rcl_interfaces/srv/GetParameterTypes": "RIHS01_da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
    "rcl_interfaces/srv/GetParameters": "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/ListParameters": "RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/SetParameters": "RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "rcl_interfaces/srv/SetParametersAtomically": "RIHS01_0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
}

DEFINITIONS = dict(MESSAGES)
for service, (request, reply) in SERVICES.items():
    DEFINITIONS |= {f"{service}_Request": request, f"{service}_Response": reply}
CODEC = Codec(DEFINITIONS)


def dds_name(name: str) -> str:
    """Returns the name of `PACKAGE/msg|srv|action/NAME` in keys."""
    package, kind, base = name.split("/")
    return f"{package}::{kind}::dds_::{base}_"


def identity(name: str) -> tuple[str, str]:
    """Returns the type and the hash in the keys of an interface."""
    return dds_name(name), HASHES[name]


class Message:
    """The codec of a message type."""

    def __init__(self, name: str) -> None:
        self.identity = identity(name)
        self.kind = name.replace("/msg/", "/")

    def encode(self, message: dict) -> bytes:
        return CODEC.encode(self.kind, message)

    def decode(self, data: bytes) -> dict:
        return CODEC.decode(self.kind, data)


class Service:
    """The codecs of a service."""

    def __init__(self, name: str) -> None:
        self.identity = identity(name)
        self.request, self.reply = f"{name}_Request", f"{name}_Response"

    def encode_request(self, message: dict) -> bytes:
        return CODEC.encode(self.request, message)

    def decode_request(self, data: bytes) -> dict:
        return CODEC.decode(self.request, data)

    def encode_reply(self, message: dict) -> bytes:
        return CODEC.encode(self.reply, message)

    def decode_reply(self, data: bytes) -> dict:
        return CODEC.decode(self.reply, data)
