#!/usr/bin/env python3
"""Checks the golden vectors of sealing and signing with a second implementation: Python's `cryptography`.

Without arguments it checks crates/sgc-trust/tests/vectors/sealing.json, which the tests of sgc-trust check too.
With --write it makes that file anew; the packets that Rust signs with RSA are then to be filled in with
    cargo test -p sgc-trust --test vectors -- --ignored --nocapture | scripts/trust-vectors.py --take
It also checks grants.json beside it, which --write-grants makes: grants sealed with HPKE (RFC 9180, base mode), put
together here from HKDF, X25519 and AES-GCM. Of X-Wing the shared secret is the draft's own, from xwing.txt.
And macs.json, which --write-macs makes: packets of the pairwise suites with a MAC for each receiver, and the grant that
brings the key.
And revocation.json, which --write-revocation makes: a CA, a node's certificate and a fleet's revocation list, byte for
byte as Rust makes it.
Rules: docs/spec/trust.md, docs/spec/wire.md.
"""
import datetime
import hashlib
import hmac
import json
import pathlib
import struct
import sys

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, padding, rsa, x25519
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

GRANTS = pathlib.Path(__file__).parent.parent / "crates/sgc-trust/tests/vectors/grants.json"
REVOCATION = GRANTS.with_name("revocation.json")
MACS = GRANTS.with_name("macs.json")
XWING = GRANTS.with_name("xwing.txt")
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
    9: ("pairwise", AESGCM, "ed25519"),
    10: ("pairwise-chacha", ChaCha20Poly1305, "ed25519"),
}
PAIRWISE = (9, 10)
TOPIC_KEY, EPOCH = bytes(range(32)), 7
NAME, SOURCE, SINK = b"\xaa" * 32, b"\xbb" * 16, b"\xcc" * 16
GRID, TIMESTAMP = 16, 1_795_391_999_000_000_000
# Sequence number, total, index, addressed; the last is the mark of synchrony.
PACKETS = [(1, 5, 0, False), (2, 40, 0, False), (2, 40, 1, False), (2, 40, 2, False), (0, 0, 0, True)]
SIGNATURE_BYTES = {"ed25519": 64, "rsa-2048": 256, "rsa-3072": 384}


def hkdf(suite, sink=b"", salt=b"sgc source v1", key=TOPIC_KEY):
    """RFC 5869, one block."""
    info = struct.pack(">BI", suite, EPOCH) + NAME + SOURCE + sink
    prk = hmac.digest(salt, key, "sha256")
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


def leaf_hash(suite, packet, text):
    return hashlib.sha256(b"\x00" + header(suite, *packet) + text).digest()


def form(suite):
    """The byte in front of a signature's trailer, where a trailer may also have MACs."""
    return b"\x00" if suite in PAIRWISE else b""


def batch(suite):
    texts = [sealed(suite, *p) for p in PACKETS]
    leaves = [leaf_hash(suite, p, t) for p, t in zip(PACKETS, texts)]
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
    return [t + form(suite) + b"".join(p) + n + signature for t, p, n in zip(texts, paths, place)]


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
        rest = text + form(suite) + b"".join(path) + struct.pack(">HH", i, len(texts))
        assert payload.startswith(rest), f"suite {suite}, packet {i}"
        verify(key, payload[len(rest):], message)


class Hpke:
    """RFC 9180 with HKDF-SHA256 and AES-256-GCM, base mode, one message."""

    def __init__(self, kem):
        self.kem_id = b"KEM" + struct.pack(">H", kem)
        self.id = b"HPKE" + struct.pack(">HHH", kem, 1, 2)

    @staticmethod
    def extract(suite, salt, label, ikm):
        return hmac.digest(salt or bytes(32), b"HPKE-v1" + suite + label + ikm, "sha256")

    @staticmethod
    def expand(suite, prk, label, info, length):
        """At most one block."""
        info = struct.pack(">H", length) + b"HPKE-v1" + suite + label + info
        return hmac.digest(prk, info + b"\x01", "sha256")[:length]

    def dh_secret(self, dh, enc, public):
        """DHKEM's ExtractAndExpand (4.1)."""
        prk = self.extract(self.kem_id, b"", b"eae_prk", dh)
        return self.expand(self.kem_id, prk, b"shared_secret", enc + public, 32)

    def seal(self, shared, info, aad, text):
        """KeySchedule (5.1) and Seal (5.2)."""
        context = b"\x00" + self.extract(self.id, b"", b"psk_id_hash", b"") + self.extract(self.id, b"", b"info_hash", info)
        secret = self.extract(self.id, shared, b"secret", b"")
        key = self.expand(self.id, secret, b"key", context, 32)
        nonce = self.expand(self.id, secret, b"base_nonce", context, 12)
        return AESGCM(key).encrypt(nonce, text, aad)


def receiver_key(secret, node):
    """RFC 5869: the id of the key in packets, 4 bytes, and the key, 32 bytes."""
    prk, info = hmac.digest(b"sgc receiver v1", secret, "sha256"), NAME + node
    first = hmac.digest(prk, info + b"\x01", "sha256")
    okm = first + hmac.digest(prk, first + info + b"\x02", "sha256")
    return okm[:4], okm[4:36]


def macs():
    secret, nodes = bytes(range(64, 96)), [b"\x51" * 32, b"\x52" * 32]
    keys = [receiver_key(secret, node) for node in nodes]

    def packet(suite, packet):
        text = sealed(suite, *packet)
        seq, _, index, addressed = packet
        nonce = struct.pack(">QI", seq, index)

        def mac(key):
            aead = SUITES[suite][1](hkdf(suite, SINK if addressed else b"", b"sgc mac v1", key + TOPIC_KEY))
            return aead.encrypt(nonce, header(suite, *packet), text)[-16:]

        entries = [key_id + mac(key) for key_id, key in keys]
        return text + b"\x01" + struct.pack(">B", len(keys)) + b"".join(entries)

    key_id, key = keys[0]
    content = b"\x00" + struct.pack(">IB", EPOCH, 9) + TOPIC_KEY + b"\x01" + key_id + key + struct.pack(">I", 0) + b"\x00"
    return {
        "note": "Keys of tests, which protect nothing.",
        "secret": secret.hex(),
        "nodes": [node.hex() for node in nodes],
        "keys": [(key_id + key).hex() for key_id, key in keys],
        "suites": [
            {
                "suite": SUITES[suite][0],
                "headers": [header(suite, *p).hex() for p in PACKETS],
                "payloads": [packet(suite, p).hex() for p in PACKETS],
            }
            for suite in PAIRWISE
        ],
        "content": content.hex(),
    }


def write_macs():
    MACS.write_text(json.dumps(macs(), indent=1) + "\n")


def raw_public(private):
    return private.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def topic_grant():
    """GrantContent::Topic with one source and no entry."""
    source = SOURCE + struct.pack(">I", 32) + b"\xdd" * 32 + struct.pack(">QQQ", 5, 9, 3)
    return b"\x00" + struct.pack(">IB", EPOCH, 3) + TOPIC_KEY + struct.pack(">I", 1) + source + b"\x00"


def xwing_vector():
    """The first vector of the draft."""
    lines = [line.split(" = ") for line in XWING.read_text().splitlines() if " = " in line]
    return {name: bytes.fromhex(value) for name, value in reversed(lines[:6])}


def grants():
    text, serial = topic_grant(), 0x0102030405060708
    info, aad = b"sgc grant v1" + NAME + SINK, struct.pack(">Q", serial)
    ours, fresh = (x25519.X25519PrivateKey.from_private_bytes(bytes([b]) * 32) for b in (0x11, 0x22))
    enc, public = raw_public(fresh), raw_public(ours)
    kem = Hpke(0x0020)
    sealed = kem.seal(kem.dh_secret(fresh.exchange(ours.public_key()), enc, public), info, aad, text)
    out = [("x25519", b"\x11" * 32, public, enc, sealed)]
    v = xwing_vector()
    ek = v["pk"][:1184]
    private = v["sk_m_s"] + ek + hashlib.sha3_256(ek).digest() + v["sk_m_z"] + v["sk_x"]
    out.append(("xwing", private, v["pk"], v["ct"], Hpke(0x647A).seal(v["ss"], info, aad, text)))
    names = ("kem", "private", "public", "enc", "sealed")
    return {
        "note": "Keys of tests, which protect nothing.",
        "serial": serial,
        "content": text.hex(),
        "grants": [dict(zip(names, [kem] + [b.hex() for b in rest])) for kem, *rest in out],
    }


def write_grants():
    GRANTS.write_text(json.dumps(grants(), indent=1) + "\n")


def der(tag, *content):
    """One element of DER."""
    content = b"".join(content)
    length = len(content).to_bytes((len(content).bit_length() + 7) // 8 or 1, "big")
    head = length if len(content) < 0x80 else bytes([0x80 | len(length)]) + length
    return bytes([tag]) + head + content


def der_integer(number):
    return der(0x02, number.to_bytes(number.bit_length() // 8 + 1, "big"))


def revocation():
    """A CA with an Ed25519 key, whose signatures are the same each time."""
    begin = datetime.datetime.fromtimestamp(1_795_000_000, datetime.UTC)
    day = datetime.timedelta(days=1)
    key = ed25519.Ed25519PrivateKey.from_private_bytes(b"\x33" * 32)
    pkcs8 = key.private_bytes(
        serialization.Encoding.DER, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "golden CA")])
    key_id = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    usage = dict.fromkeys(
        "digital_signature content_commitment key_encipherment data_encipherment key_agreement "
        "encipher_only decipher_only".split(), False
    )
    ca = (
        x509.CertificateBuilder(name, name, key.public_key(), 1, begin - day, begin + 3650 * day)
        .add_extension(x509.BasicConstraints(True, 1), True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), True)
        .add_extension(key_id, False)
        .sign(key, None)
    )
    pseudonym = bytes(range(32))
    uris = ["sgc:node:" + pseudonym.hex(), "sgc:incarnation:3"]
    node_key = ed25519.Ed25519PrivateKey.from_private_bytes(b"\x44" * 32)
    node_name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, pseudonym.hex())])
    leaf = (
        x509.CertificateBuilder(name, node_name, node_key.public_key(), 2, begin - day, begin + 90 * day)
        .add_extension(x509.SubjectAlternativeName([x509.UniformResourceIdentifier(u) for u in uris]), False)
        .sign(key, None)
    )
    # Pseudonym, highest revoked incarnation, since when: by rising pseudonym.
    nodes = [(pseudonym, 2, 1_795_000_000), (b"\x80" * 32, 128, 1_600_000_000), (b"\xff" * 32, 0xFFFFFFFF, 0)]
    value = der(0x30, *(der(0x30, der(0x04, n), der_integer(i), der_integer(t)) for n, i, t in nodes))
    oid = x509.ObjectIdentifier("2.25.119781345836387798361097549824228883350")
    number = 1_795_000_001
    crl = (
        x509.CertificateRevocationListBuilder(name, begin, begin + 30 * day)
        .add_extension(x509.AuthorityKeyIdentifier(key_id.digest, None, None), False)
        .add_extension(x509.CRLNumber(number), False)
        .add_extension(x509.UnrecognizedExtension(oid, value), False)
        .sign(key, None)
    )
    encoding = serialization.Encoding.DER
    return {
        "note": "Keys of tests, which protect nothing.",
        "now_secs": int(begin.timestamp()),
        "ca": ca.public_bytes(encoding).hex(),
        "ca_key": pkcs8.hex(),
        "leaf": leaf.public_bytes(encoding).hex(),
        "incarnation": 3,
        "number": number,
        "nodes": [{"pseudonym": n.hex(), "incarnation": i, "revoked_secs": t} for n, i, t in nodes],
        "list": crl.public_bytes(encoding).hex(),
    }


def write_revocation():
    REVOCATION.write_text(json.dumps(revocation(), indent=1) + "\n")


def check():
    assert json.loads(REVOCATION.read_text()) == revocation(), "revocation list"
    print(f"a revocation list agrees with {REVOCATION.name}")
    assert json.loads(MACS.read_text()) == macs(), "MACs"
    print(f"{len(PAIRWISE)} suites with MACs agree with {MACS.name}")
    assert json.loads(GRANTS.read_text()) == grants(), "grants"
    print(f"2 kinds of grants agree with {GRANTS.name}")
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
    {
        (): check,
        ("--write",): write,
        ("--take",): take,
        ("--write-grants",): write_grants,
        ("--write-macs",): write_macs,
        ("--write-revocation",): write_revocation,
    }[tuple(sys.argv[1:])]()
