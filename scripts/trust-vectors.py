#!/usr/bin/env python3
"""Checks the golden vectors of sealing and signing with a second implementation: Python's `cryptography`.

Without arguments it checks crates/sgc-trust/tests/vectors/sealing.json, which the tests of sgc-trust check too.
With --write it makes that file anew; the packets that Rust signs with RSA are then to be filled in with
    cargo test -p sgc-trust --test vectors -- --ignored --nocapture | scripts/trust-vectors.py --take
Rules: docs/spec/trust.md, docs/spec/wire.md.
"""
import hashlib
import hmac
import json
import pathlib
import struct
import sys

from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, padding, rsa
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

FILE = pathlib.Path(__file__).parent.parent / "crates/sgc-trust/tests/vectors/sealing.json"
SUITES = {
    1: ("group", AESGCM, None),
    2: ("group-chacha", ChaCha20Poly1305, None),
    3: ("standard", AESGCM, "ed25519"),
    4: ("standard-chacha", ChaCha20Poly1305, "ed25519"),
    5: ("paper", AESGCM, "rsa-2048"),
    6: ("paper-3072", AESGCM, "rsa-3072"),
    7: ("paper-chacha", ChaCha20Poly1305, "rsa-2048"),
    8: ("paper-3072-chacha", ChaCha20Poly1305, "rsa-3072"),
}
TOPIC_KEY, EPOCH = bytes(range(32)), 7
NAME, SOURCE, SINK = b"\xaa" * 32, b"\xbb" * 16, b"\xcc" * 16
GRID, TIMESTAMP = 16, 1_795_391_999_000_000_000
# Sequence number, total, index, addressed; the last is the mark of synchrony.
PACKETS = [(1, 5, 0, False), (2, 40, 0, False), (2, 40, 1, False), (2, 40, 2, False), (0, 0, 0, True)]
SIGNATURE_BYTES = {"ed25519": 64, "rsa-2048": 256, "rsa-3072": 384}


def hkdf(suite, sink=b""):
    """RFC 5869, one block."""
    info = struct.pack(">BI", suite, EPOCH) + NAME + SOURCE + sink
    prk = hmac.digest(b"sgc source v1", TOPIC_KEY, "sha256")
    return hmac.digest(prk, info + b"\x01", "sha256")


def header(suite, seq, total, index, addressed):
    flags = 0x01 | (0x02 if addressed else 0) | (2 << 2)  # reliable, realtime
    out = struct.pack(">BBBBI", 0x10, flags, 0, suite, EPOCH) + NAME + SOURCE
    out += struct.pack(">QIHHI", seq, total, index, GRID, 0)
    return out + (SINK if addressed else b"")


def sealed(suite, seq, total, index, addressed):
    text = bytes((i * 7 + seq) % 251 for i in range(total))[index * GRID:][:GRID]
    if index == 0:
        kind, timestamp = (3, 0) if addressed else (0, TIMESTAMP)
        text += struct.pack(">BBHQ", kind, 0, 0, timestamp)
    aead = SUITES[suite][1](hkdf(suite, SINK if addressed else b""))
    return aead.encrypt(struct.pack(">QI", seq, index), text, header(suite, seq, total, index, addressed))


def tree(leaves):
    """RFC 6962, 2.1, as it is written there: the root, and the audit path of each leaf (2.1.1)."""
    if len(leaves) == 1:
        return leaves[0], [[]]
    k = 1
    while k * 2 < len(leaves):
        k *= 2
    (left, left_paths), (right, right_paths) = tree(leaves[:k]), tree(leaves[k:])
    root = hashlib.sha256(b"\x01" + left + right).digest()
    return root, [p + [right] for p in left_paths] + [p + [left] for p in right_paths]


def batch(suite):
    texts = [sealed(suite, *p) for p in PACKETS]
    leaves = [hashlib.sha256(b"\x00" + header(suite, *p) + t).digest() for p, t in zip(PACKETS, texts)]
    root, paths = tree(leaves)
    return texts, paths, b"sgc batch v1\x00" + struct.pack(">H", len(leaves)) + root


def pss():
    return padding.PSS(mgf=padding.MGF1(hashes.SHA256()), salt_length=32), hashes.SHA256()


def sign(key, message):
    return key.sign(message) if isinstance(key, ed25519.Ed25519PrivateKey) else key.sign(message, *pss())


def verify(key, signature, message):
    public = key.public_key()
    extra = () if isinstance(key, ed25519.Ed25519PrivateKey) else pss()
    public.verify(signature, message, *extra)


def public_bytes(key):
    if isinstance(key, ed25519.Ed25519PrivateKey):
        return key.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    spki = serialization.PublicFormat.SubjectPublicKeyInfo
    return key.public_key().public_bytes(serialization.Encoding.DER, spki)


def load(pkcs8):
    return serialization.load_der_private_key(bytes.fromhex(pkcs8), None)


def payloads(suite, key):
    texts, paths, message = batch(suite)
    if key is None:
        return texts
    signature = sign(key, message)
    place = [struct.pack(">HH", i, len(texts)) for i in range(len(texts))]
    return [t + b"".join(p) + n + signature for t, p, n in zip(texts, paths, place)]


def write():
    new = {
        "ed25519": ed25519.Ed25519PrivateKey.from_private_bytes(b"\x42" * 32),
        "rsa-2048": rsa.generate_private_key(65537, 2048),
        "rsa-3072": rsa.generate_private_key(65537, 3072),
    }
    der = (serialization.Encoding.DER, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    keys = {kind: {"pkcs8": key.private_bytes(*der).hex(), "public": public_bytes(key).hex()} for kind, key in new.items()}
    suites = []
    for suite, (name, _, kind) in SUITES.items():
        suites.append({
            "suite": name,
            "key": kind,
            "source_key": hkdf(suite).hex(),
            "addressed_key": hkdf(suite, SINK).hex(),
            "headers": [header(suite, *p).hex() for p in PACKETS],
            "payloads": [p.hex() for p in payloads(suite, new.get(kind))],
        })
    save({"note": "Keys of tests, which protect nothing.", "keys": keys, "suites": suites, "signed_by_rust": {}})


def take():
    content = json.loads(FILE.read_text())
    for line in sys.stdin:
        if line.startswith("vector "):
            _, suite, *payloads = line.split()
            content["signed_by_rust"][suite] = payloads
    save(content)


def save(content):
    FILE.parent.mkdir(parents=True, exist_ok=True)
    FILE.write_text(json.dumps(content, indent=1) + "\n")


def check_signed(suite, key, given):
    """That every payload is what this script makes, but for a signature that may be random."""
    texts, paths, message = batch(suite)
    assert len(given) == len(texts)
    for i, (text, path, payload) in enumerate(zip(texts, paths, given)):
        rest = text + b"".join(path) + struct.pack(">HH", i, len(texts))
        assert payload.startswith(rest), f"suite {suite}, packet {i}"
        verify(key, payload[len(rest):], message)


def check():
    content = json.loads(FILE.read_text())
    assert [v["suite"] for v in content["suites"]] == [name for name, _, _ in SUITES.values()]
    for (suite, (name, _, kind)), vector in zip(SUITES.items(), content["suites"]):
        assert vector["source_key"] == hkdf(suite).hex(), name
        assert vector["addressed_key"] == hkdf(suite, SINK).hex(), name
        assert vector["headers"] == [header(suite, *p).hex() for p in PACKETS], name
        given = [bytes.fromhex(p) for p in vector["payloads"]]
        if kind is None:
            assert given == payloads(suite, None), name
            continue
        key = load(content["keys"][kind]["pkcs8"])
        assert content["keys"][kind]["public"] == public_bytes(key).hex(), kind
        assert all(len(p) - SIGNATURE_BYTES[kind] > 0 for p in given)
        check_signed(suite, key, given)
        if kind.startswith("rsa"):
            check_signed(suite, key, [bytes.fromhex(p) for p in content["signed_by_rust"][name]])
    print(f"{len(SUITES)} suites agree with {FILE.name}")


if __name__ == "__main__":
    {(): check, ("--write",): write, ("--take",): take}[tuple(sys.argv[1:])]()
