#!/usr/bin/env python3
"""Checks the access token that `sgc-gateway` tests against: its bytes, from docs/spec/gateway.md and Python's library, and its
signature, with the package `cryptography`."""

import base64
import json
import pathlib
import struct
import sys

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

FILE = pathlib.Path(__file__).parent.parent / "crates/sgc-gateway/tests/vectors/access.json"
PREFIX = "sgc-access-1:"
CONTEXT = b"sgc access token v1"


def counted(data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + data


def listed(items: list[str]) -> bytes:
    return struct.pack(">I", len(items)) + b"".join(counted(item.encode()) for item in items)


def main() -> int:
    vector = json.loads(FILE.read_text())
    content = b"\x01" + bytes.fromhex(vector["id"]) + bytes.fromhex(vector["gateway"])
    content += counted(vector["label"].encode())
    content += b"".join(listed(patterns) for patterns in vector["scope"])
    content += struct.pack(">QQ", vector["issued"], vector["expires"])
    text = vector["token"]
    if not text.startswith(PREFIX):
        print(f"it does not begin with {PREFIX}")
        return 1
    base = text.removeprefix(PREFIX)
    token = base64.urlsafe_b64decode(base + "=" * (-len(base) % 4))
    if not token.startswith(content):
        print("the bytes of the token are not those of the specification")
        return 1
    rest = token.removeprefix(content)
    signature = rest[4:]
    if counted(signature) != rest:
        print("the signature does not end where its length says")
        return 1
    key = x509.load_der_x509_certificate(base64.b64decode(vector["chain"][0])).public_key()
    key.verify(signature, CONTEXT + b"\0" + content, ec.ECDSA(hashes.SHA256()))
    print(f"access token: {len(content)} bytes and a signature of {len(signature)}, as specified")
    return 0


sys.exit(main())
