#!/usr/bin/env python3
"""Prints the golden vectors of name derivation, computed independently of the Rust code."""
import hashlib
import hmac
import struct


def metadata(kind, *fields):
    out = bytes([1, kind])
    for text in fields:
        out += struct.pack(">I", len(text)) + text.encode()
    return out


def name(fleet, owner, encoded):
    prk = hmac.digest(b"sgc topic secret v1", fleet, "sha256")
    secret = hmac.digest(prk, encoded + b"\x01", "sha256")
    blind = hmac.digest(secret, b"sgc name", "sha256")
    return hashlib.sha256(b"sgc name v1" + owner + blind).hexdigest()


FLEET, OWNER = b"\x11" * 32, b"\x22" * 32
TOPIC = ("arm-1", "/camera/image", "sensor_msgs/msg/Image")
OPTIONAL = ("/camera", "Ada", "ops@example.org", "v4l2", "wrist camera", "left")
print("plain    ", name(FLEET, OWNER, metadata(1, *TOPIC, *[""] * 6)))
print("full     ", name(FLEET, OWNER, metadata(1, *TOPIC, *OPTIONAL)))
print("catalogue", name(FLEET, OWNER, metadata(0, "arm-1", *[""] * 8)))
