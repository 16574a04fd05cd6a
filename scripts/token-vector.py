#!/usr/bin/env python3
"""Prints the token that `sgc-trust`'s test of `token.rs` knows, from docs/spec/trust.md and Python's library alone."""

import base64
import hashlib
import hmac
import struct
import sys


def text(value: str) -> bytes:
    data = value.encode()
    return struct.pack(">I", len(data)) + data


def metadata(owner: str, topic: str, type_name: str) -> bytes:
    fields = [owner, topic, type_name, "", "", "", "", "", ""]
    return bytes([1, 1]) + b"".join(text(field) for field in fields)


def main() -> None:
    ca = base64.b64decode(sys.argv[1])
    owner, secret = bytes([0x22]) * 32, bytes([0x33]) * 32
    routers = ["quic://router.lab.example:7447", "quic://10.0.0.1:7447"]
    content = bytes([1]) + owner + text("arm-1")
    content += struct.pack(">I", len(ca)) + ca
    content += metadata("arm-1", "/handoff/pose", "geometry_msgs/msg/PoseStamped")
    content += secret
    content += struct.pack(">I", len(routers)) + b"".join(text(url) for url in routers)
    content += struct.pack(">Q", 1_800_000_000_000)
    checksum = hashlib.sha256(b"sgc token v1" + content).digest()[:4]
    print("sgc-token-1:" + base64.urlsafe_b64encode(content + checksum).decode().rstrip("="))
    blind = hmac.new(secret, b"sgc name", hashlib.sha256).digest()
    print(hashlib.sha256(b"sgc name v1" + owner + blind).hexdigest())


main()
