#!/usr/bin/env python3
"""Prints known-answer vectors of identities and secrets, computed independently of the Rust code."""
import hashlib
import hmac

SECRET = bytes(range(32))
ROTATED = bytes(range(32, 64))
# A P-256 SubjectPublicKeyInfo around a point that is none: only its bytes matter here.
SPKI = bytes.fromhex("3059301306072a8648ce3d020106082a8648ce3d03010703420004") + bytes(range(64))


def tag(domain, name):
    return hmac.digest(SECRET, domain + b"\0" + name, "sha256")


def name(secret, owner, metadata):
    prk = hmac.digest(b"sgc topic secret v1", secret, "sha256")
    topic = hmac.digest(prk, metadata + b"\x01", "sha256")
    blind = hmac.digest(topic, b"sgc name", "sha256")
    return hashlib.sha256(b"sgc name v1" + owner + blind)


def metadata(kind, *fields):
    out = bytes([1, kind])
    for text in fields:
        out += len(text).to_bytes(4, "big") + text.encode()
    return out


pseudonym = tag(b"sgc pseudonym v1", b"arm-1")
node = hashlib.sha256(SPKI + pseudonym).digest()
ca = hashlib.sha256(SPKI).digest()
renewal = hashlib.sha256(b"sgc renewal v1" + ca).digest()
types = hashlib.sha256(b"sgc types v1" + node).digest()
consumers = hashlib.sha256(b"sgc consumers v1" + node).digest()
reports = hashlib.sha256(b"sgc reports v1" + node).digest()
paths = hashlib.sha256(b"sgc paths v1" + node).digest()
clock = hashlib.sha256(b"sgc clock v1" + node).digest()
wishes = hashlib.sha256(b"sgc wishes v1" + node).digest()
topic = metadata(1, "arm-1", "/camera/image", "sensor_msgs/msg/Image", *[""] * 6)
print("pseudonym of arm-1      ", pseudonym.hex())
print("group tag of operators  ", tag(b"sgc group v1", b"operators").hex())
print("node id of arm-1        ", node.hex())
print("CA fingerprint          ", ca.hex())
print("renewal blind           ", renewal.hex())
print("renewal name            ", hashlib.sha256(b"sgc name v1" + node + renewal).hexdigest())
print("types blind             ", types.hex())
print("types name              ", hashlib.sha256(b"sgc name v1" + node + types).hexdigest())
print("consumers blind         ", consumers.hex())
print("consumers name          ", hashlib.sha256(b"sgc name v1" + node + consumers).hexdigest())
print("reports blind           ", reports.hex())
print("reports name            ", hashlib.sha256(b"sgc name v1" + node + reports).hexdigest())
print("paths blind             ", paths.hex())
print("paths name              ", hashlib.sha256(b"sgc name v1" + node + paths).hexdigest())
print("clock blind             ", clock.hex())
print("clock name              ", hashlib.sha256(b"sgc name v1" + node + clock).hexdigest())
print("wishes blind            ", wishes.hex())
print("wishes name             ", hashlib.sha256(b"sgc name v1" + node + wishes).hexdigest())
print("/camera/image, gen. 1   ", name(SECRET, node, topic).hexdigest())
print("/camera/image, gen. 2   ", name(ROTATED, node, topic).hexdigest())
