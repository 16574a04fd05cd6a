#!/usr/bin/env python3
"""Random messages of every interface that ships and that PyPI's `rosbags` knows, serialised by `rosbags` in both byte orders and
decoded by `sgc-cdr`: each member has to be what it was, and the bytes the same again by way of JSON and of CBOR. JSON that is
written here has to become the bytes of `rosbags`. So has the hash of each type, by way of its description.

  cdr-vectors.py [SEED [MESSAGES_OF_EACH]]"""

import base64
import json
import math
import os
import pathlib
import random
import struct
import subprocess
import sys

import numpy
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

ROOT = pathlib.Path(__file__).resolve().parent.parent
STORE = get_typestore(Stores.ROS2_KILTED)
# `rosbags` takes `char` for a type of its own where ROS 2 writes uint8.
HASHES_DIFFER = {"std_msgs/msg/Char", "service_msgs/msg/ServiceEventInfo", "rmw_dds_common/msg/Gid", "rmw_dds_common/msg/NodeEntitiesInfo",
                 "rmw_dds_common/msg/ParticipantEntitiesInfo"}
# Messages without members have it, and JSON does not show it.
DUMMY = "structure_needs_at_least_one_member"
BITS = {"int8": 8, "int16": 16, "int32": 32, "int64": 64, "uint8": 8, "uint16": 16, "uint32": 32, "uint64": 64, "byte": 8, "char": 8}


def base(rng: random.Random, name: str, bound: int):
    if name == "bool":
        return rng.random() < 0.5
    if name == "string":
        length = min(rng.choice([0, 1, 2, 3, 7, 20]), (bound or 99) // 4)
        return "".join(rng.choice("aZ0 _/\"'\\\n\tüß€😀") for _ in range(length))
    if name in BITS:
        bits, unsigned = BITS[name], not name.startswith("int")
        # `rosbags` takes these for signed.
        bits -= name in ("byte", "char")
        low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return rng.choice([low, high, 0, 1, rng.randint(low, high)])
    value = rng.choice([0.0, -0.0, 1.5, math.inf, -math.inf, math.nan, rng.uniform(-1e9, 1e9), 1e-40])
    return struct.unpack("<f", struct.pack("<f", value))[0] if name == "float32" else value


def made(rng: random.Random, desc, depth: int):
    """A value for the serialiser, and what is expected."""
    kind, rest = desc
    if kind == Nodetype.BASE:
        value = base(rng, *rest)
        return value, value
    if kind == Nodetype.NAME:
        return message(rng, rest, depth + 1)
    inner, count = rest
    if kind == Nodetype.SEQUENCE:
        count = min(rng.choice([0, 1, 2, 5] if depth < 3 else [0, 1]), count or 99)
    pairs = [made(rng, inner, depth) for _ in range(count)]
    values, expected = [p[0] for p in pairs], [p[1] for p in pairs]
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        kind = {"byte": "uint8", "char": "uint8"}.get(inner[1][0], inner[1][0])
        values = numpy.array(values, dtype=numpy.dtype(kind))
        if kind == "uint8":
            expected = bytes(expected)
    return values, expected


def message(rng: random.Random, name: str, depth: int = 0):
    values, expected = {}, {}
    for field, desc in STORE.fielddefs[name][1]:
        values[field], expected[field] = made(rng, desc, depth)
    return STORE.types[name](**values), expected


def same(found, expected) -> bool:
    if isinstance(expected, dict):
        expected = {k: v for k, v in expected.items() if k != DUMMY}
        return list(found) == list(expected) and all(same(found[k], v) for k, v in expected.items())
    if isinstance(expected, bytes):
        return base64.b64decode(found, validate=True) == expected
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(same, found, expected))
    if isinstance(expected, float):
        if isinstance(found, str):
            found = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}[found]
        if math.isnan(expected):
            return math.isnan(found)
        if math.copysign(1, found) != math.copysign(1, expected):
            return False
        narrow = lambda x: struct.pack("<f", x) if abs(x) < 3.5e38 else b""
        # A float32 comes with the fewest digits that tell it from others.
        is_narrow = expected == 0 or math.isinf(expected) or struct.unpack("<f", narrow(expected) or b"\0\0\0\0")[0] == expected
        return found == expected or (is_narrow and narrow(found) == narrow(expected))
    return type(found) is type(expected) and found == expected


def plain(rng: random.Random, value):
    """What a client may write: 64-bit integers as text or not, octets as base64 or numbers, members in any order."""
    if isinstance(value, dict):
        members = [(k, plain(rng, v)) for k, v in value.items() if k != DUMMY or rng.random() < 0.5]
        rng.shuffle(members)
        return dict(members)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode() if rng.random() < 0.5 else list(value)
    if isinstance(value, list):
        return [plain(rng, v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return rng.choice(["NaN", None]) if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if type(value) is int and abs(value) > 2**53 and rng.random() < 0.5:
        return str(value)
    return value


def main() -> None:
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    each = int(sys.argv[2]) if len(sys.argv) > 2 else 20
    rng = random.Random(seed)
    names = [n for n in STORE.fielddefs if not n.startswith("rosbag2_interfaces/")]
    lines, wanted = [], []
    for name in names:
        lines.append(f"hash {name}")
        wanted.append((name, None))
        for index in range(each):
            value, expected = message(rng, name)
            data = STORE.serialize_cdr(value, name, little_endian=index % 2 == 0)
            lines.append(f"{name} {bytes(data).hex()}")
            wanted.append((name, expected))
            if DUMMY in expected:
                value, expected = STORE.types[name](**{DUMMY: 0}), {DUMMY: 0}
            lines.append(f"json {name} {json.dumps(plain(rng, expected))}")
            little = bytes(STORE.serialize_cdr(value, name, little_endian=True))
            wanted.append((name, little.hex()))
    cargo = ["cargo", "run", "--quiet", "--locked", "-p", "sgc-cdr", "--example", "decode"]
    command = os.environ.get("SGC_CDR_DECODE", "").split() or cargo
    done = subprocess.run(command, cwd=ROOT, input="\n".join(lines) + "\n", capture_output=True, text=True, check=True)
    found = done.stdout.splitlines()
    if len(found) != len(lines):
        sys.exit(f"{len(lines)} lines went in, {len(found)} came out")
    wrong = 0
    for line, text, (name, expected) in zip(lines, found, wanted):
        if expected is None:
            fine = text.startswith("RIHS01_") and (name in HASHES_DIFFER or text == STORE.hash_rihs01(name))
        elif isinstance(expected, str):
            fine = text == expected
        else:
            try:
                shown, by_json, by_cbor = text.rsplit(" ", 2)
                before = line.split(" ")[1]
                # A message without members has no value to keep.
                bytes_same = by_json == by_cbor == before or DUMMY in expected
                fine = same(json.loads(shown), expected) and bytes_same
            except ValueError:
                fine = False
        if not fine:
            wrong += 1
            print(f"{line[:200]}\n  is {text[:300]}\n  not {str(expected)[:300]}")
    if wrong or len(names) < 130:
        sys.exit(f"{wrong} of {len(lines)} differ")
    print(
        f"{len(names) * each} messages of {len(names)} types decode as rosbags wrote them and are the same bytes behind JSON and CBOR, "
        f"as many become them from JSON, seed {seed}; their hashes agree"
    )


main()
