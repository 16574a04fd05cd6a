#!/usr/bin/env python3
"""Prints the code that `sgc-trust`'s test of `invitations.rs` knows, from docs/spec/trust.md and Python's library alone."""

import base64
import hashlib
import struct
import sys


def blob(data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + data


def main() -> None:
    ca = base64.b64decode(sys.argv[1])
    content = bytes([1]) + blob(b"arm-7") + blob(b"acme") + blob(b"keeper") + bytes([0x22]) * 32
    routers = [b"quic://router.lab.example:7447", b"mdns://"]
    content += struct.pack(">I", len(routers)) + b"".join(blob(url) for url in routers)
    content += bytes([1]) + blob(ca) + blob(ca) + bytes([0x33]) * 32
    checksum = hashlib.sha256(b"sgc join code v1" + content).digest()[:4]
    print("sgc-join-1:" + base64.urlsafe_b64encode(content + checksum).decode().rstrip("="))


main()
