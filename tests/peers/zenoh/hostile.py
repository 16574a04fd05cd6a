"""Role `hostile`: a session that declares and sends what no node of rmw_zenoh would, and goes on until it is ended."""

from __future__ import annotations

import argparse
import random
import time

from interfaces import identity
from rmw import ADMIN_SPACE, ATTACHMENT, GID_BYTES, PUBLISHER, SERVER, Attachment, Context, Entity, Qos
from run import EXIT_OK, Run, emit, open_context

LOAD, ADD = identity("std_msgs/msg/UInt8MultiArray"), identity("example_interfaces/srv/AddTwoInts")
NOISE_SEED = 1
HASH = "RIHS01_" + "0" * 64
# Zenoh takes the longer for a token the more there are.
REPORT_EVERY = 500
# A payload that a reader would take for a message.
BODY = b"\0\1\0\0" + bytes(36)
# Numbers that stand out among those of a publisher.
NUMBER = 1 << 40


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--topic", default="/load", help="of others, of the type of `pub --bytes`")
    parser.add_argument("--name", default="/add_two_ints", help="of a service of others, example_interfaces/srv/AddTwoInts")
    parser.add_argument("--tokens", type=int, default=1000, help="of publishers, each on a topic of its own")


def odd_tokens(context: Context) -> list[str]:
    """Returns keys below that of the domain's tokens that are none of rmw_zenoh, and tokens of other domains."""
    begin = f"{ADMIN_SPACE}/{context.domain}/{context.zid}"
    good = entity(context, 1, "/odd").token()
    chunks = good.split("/")

    def with_chunk(at: int, chunk: str) -> str:
        return "/".join([*chunks[:at], chunk, *chunks[at + 1 :]])

    cut = ["/".join(chunks[:count]) for count in range(2, len(chunks))]
    numbers = [with_chunk(at, text) for at in (1, 3, 4) for text in ("-1", "1e3", "99999999999999999999", "٣", "0x1")]
    sessions = [with_chunk(2, text) for text in ("0", "xyz", "f" * 33, "A" * 8, "%")]
    kinds = [with_chunk(5, text) for text in ("XX", "mp", "NN", "MPMP")]
    names = [with_chunk(at, text) for at in (6, 7, 8) for text in ("%%", "%a b", "a" * 5000, "%\u202e", "%a%", "1")]
    topics = [with_chunk(9, text) for text in ("%", "%%", "%a%%b", "%" + "x" * 300, "%.", "%@", "nothing")]
    types = [with_chunk(at, text) for at in (10, 11) for text in ("%", "y" * 2000, "::", "\u0001", "EMPTY_TOPIC_TYPE")]
    qos = [with_chunk(12, text) for text in (":", "9:9:9,9:9,9:9,9:9,9,9", "::,99999999999999999999:,:,:,,", "a:b:c:d:e:f", "::::::::")]
    far = [with_chunk(1, str(domain)) for domain in (1, 232, 4294967295, 4294967296)]
    endless = [f"{begin}/0/1/MP" + "/x" * 2000, f"{good}/backends:{'z' * 4000}", f"{begin}/0/2/NN/%/%/node/more"]
    return [*cut, *numbers, *sessions, *kinds, *names, *topics, *types, *qos, *far, *endless]


def entity(context: Context, number: int, topic: str, kind: str = PUBLISHER, of: tuple[str, str] = LOAD) -> Entity:
    ids = (context.domain, context.zid, 0, number)
    return Entity(*ids, kind, "/", "/", "hostile", topic, *of, Qos().text())


def odd_attachments() -> list[bytes | None]:
    """Returns attachments that are too short, too long, of rmw_zenoh before 0.2.4, or of another form."""
    good = Attachment(NUMBER, time.time_ns(), bytes(GID_BYTES)).encode()
    fields = (b"\x0fsequence_number", good[:8]), (b"\x10source_timestamp", good[8:16]), (b"\x0asource_gid", good[16:])
    old = b"".join(name + value for name, value in fields)
    noise = random.Random(NOISE_SEED).randbytes
    wrong_length = [ATTACHMENT.pack(NUMBER, 0, length, bytes(GID_BYTES)) for length in (0, 15, 17, 255)]
    return [None, b"", good[:1], good[:32], good + b"\0", old, noise(33), noise(77), bytes(128), bytes(129), bytes(1 << 20), *wrong_length]


def odd_payloads() -> list[bytes]:
    return [b"", b"\0", b"\0\1", b"\0\1\0"]


def send_all(context: Context, publisher: Entity, service: str, gid: bytes) -> int:
    """Publishes and asks. Returns how often."""
    session, key, sent = context.session, publisher.key(), 0
    good = Attachment(NUMBER, time.time_ns(), gid).encode()
    wild = [f"{context.domain}/**", f"{context.domain}/*/**", f"{key.split('/')[0]}/**/{LOAD[1]}", "**"]
    bad = [(BODY, attachment) for attachment in odd_attachments()] + [(payload, good) for payload in odd_payloads()]
    for payload, attachment in bad:
        for at in (key, *wild):
            session.put(at, payload, attachment=attachment)
            sent += 1
        # Nobody waits for the answers.
        session.get(service, lambda _: None, payload=payload, attachment=attachment, timeout=1.0)
        sent += 1
    for at in (key, *wild):
        session.delete(at, attachment=good)
        sent += 1
    return sent


def hostile(args: argparse.Namespace, run: Run) -> int:
    """Declares tokens, reports `declaring` and `declared`, and at each line sends everything once and reports `sent`."""
    with open_context(args, run) as context:
        liveliness = context.session.liveliness()
        publisher = entity(context, 0, args.topic)
        service = entity(context, 0, args.name, SERVER, ADD).key()
        refused = 0
        tokens = []
        for number in range(args.tokens):
            tokens.append(liveliness.declare_token(entity(context, number + 2, f"/flood/n{number}").token()))
            if number % REPORT_EVERY == 0:
                emit("declaring", count=number)
        for token in odd_tokens(context):
            try:
                tokens.append(liveliness.declare_token(token))
            except Exception:  # no key of Zenoh at all
                refused += 1
        emit("declared", count=len(tokens), refused=refused)
        run.read_lines()
        while run.take_line():
            emit("sent", count=send_all(context, publisher, service, bytes(GID_BYTES)))
        run.wait()
        emit("summary", role="hostile")
    return EXIT_OK


ROLES = {"hostile": (options, hostile)}
