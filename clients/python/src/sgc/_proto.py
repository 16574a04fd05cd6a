"""The protocol, from its own description: messages of ``gateway.proto``, and its calls on a channel.

The code is not generated, so the version of protoc never has to fit that of protobuf. ``gateway.binpb`` is the
description that the gateway returns by reflection.
"""

from __future__ import annotations

from importlib import resources
from typing import Any, Dict

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_PACKAGE = "sgc.gateway.v1"
_pool = descriptor_pool.DescriptorPool()
_files = descriptor_pb2.FileDescriptorSet.FromString((resources.files("sgc") / "gateway.binpb").read_bytes())
for _file in _files.file:
    _pool.AddSerializedFile(_file.SerializeToString())
_messages: Dict[str, Any] = {}


def message(name: str) -> Any:
    """Returns the class of a message, such as ``SubscribeRequest`` or ``PublishRequest.Publisher``."""
    known = _messages.get(name)
    if known is None:
        known = message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))
        _messages[name] = known
    return known


def stub(channel: Any) -> Dict[str, Any]:
    """Returns the calls of the gateway on a channel of grpc or grpc.aio, by name."""
    calls: Dict[str, Any] = {}
    for method in _files.file[-1].service[0].method:
        kinds = ("stream" if method.client_streaming else "unary", "stream" if method.server_streaming else "unary")
        request, response = (name.rsplit(".", 1)[1] for name in (method.input_type, method.output_type))
        calls[method.name] = getattr(channel, "_".join(kinds))(
            f"/{_PACKAGE}.Gateway/{method.name}",
            request_serializer=message(request).SerializeToString,
            response_deserializer=message(response).FromString,
        )
    return calls
