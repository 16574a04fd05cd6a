"""Pins: a hash of a gateway's public key, by which a program knows the gateway without a certificate authority."""

from __future__ import annotations

import base64
import hashlib
import hmac
import socket
import ssl
from typing import Optional, Tuple

_SEQUENCE, _VERSION = 0x30, 0xA0


class PinMismatch(Exception):
    """The server has another key than the pinned one."""


def certificate(host: str, port: int, pin: str, server_name: Optional[str], timeout: float) -> bytes:
    """Returns the certificate of the server, PEM, if its key has this pin.

    Nothing is sent to the server besides the handshake. A connection that trusts this certificate, and no other, is one
    to the holder of the pinned key.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    # The pin takes the place of verification.
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with socket.create_connection((host, port), timeout) as raw:
        with context.wrap_socket(raw, server_hostname=server_name or host) as tls:
            der = tls.getpeercert(binary_form=True) or b""
    found = of(der)
    if not hmac.compare_digest(found, pin):
        raise PinMismatch(f"its key has the pin {found}, not {pin}")
    return ssl.DER_cert_to_PEM_cert(der).encode("ascii")


def of(der: bytes) -> str:
    """Returns the pin of a certificate: ``sha256/`` and the hash of its SubjectPublicKeyInfo in base64 (RFC 7469)."""
    digest = hashlib.sha256(_public_key(der)).digest()
    return "sha256/" + base64.b64encode(digest).decode("ascii")


def _public_key(der: bytes) -> bytes:
    """Returns the SubjectPublicKeyInfo of a certificate (RFC 5280, 4.1)."""
    at, _ = _enter(der, 0, _SEQUENCE)
    at, _ = _enter(der, at, _SEQUENCE)
    if der[at : at + 1] == bytes([_VERSION]):
        at = _content(der, at)[1]
    for _ in ("serial number", "signature", "issuer", "validity", "subject"):
        at = _content(der, at)[1]
    return der[at : _enter(der, at, _SEQUENCE)[1]]


def _enter(der: bytes, at: int, tag: int) -> Tuple[int, int]:
    if der[at : at + 1] != bytes([tag]):
        raise PinMismatch("its certificate cannot be read")
    return _content(der, at)


def _content(der: bytes, at: int) -> Tuple[int, int]:
    """Returns where the content of the element at this place begins and ends."""
    head = der[at : at + 5]
    if len(head) < 2:
        raise PinMismatch("its certificate cannot be read")
    if head[1] < 0x80:
        begin, length = at + 2, head[1]
    else:
        digits = head[1] & 0x7F
        if not 1 <= digits <= 3:
            raise PinMismatch("its certificate cannot be read")
        begin, length = at + 2 + digits, int.from_bytes(head[2 : 2 + digits], "big")
    if begin + length > len(der):
        raise PinMismatch("its certificate cannot be read")
    return begin, begin + length
