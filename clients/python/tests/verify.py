"""Programs verify a gateway: python verify.py CA PIN OTHER-PIN WSS-PORT OTHER-GRPC-PORT OTHER-WSS-PORT PORT TOKEN

CA and PIN are of the gateway at PORT and WSS-PORT. The gateway at the other ports has the same names and another key,
OTHER-PIN, like a man in the middle.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import os
import ssl
import subprocess
import sys

import grpc
import sgc
from sgc import _pin


# The snippet of docs/how-to/verify-a-gateway.md.
# snippet begin
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat


def pinned(host: str, port: int, pin: str) -> str:
    """Returns the certificate of the gateway, PEM, if its key has the pin."""
    pem = ssl.get_server_certificate((host, port))
    key = x509.load_pem_x509_certificate(pem.encode()).public_key()
    spki = key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    found = "sha256/" + base64.b64encode(hashlib.sha256(spki).digest()).decode()
    if found != pin:
        raise ssl.SSLError(f"this is another gateway: its pin is {found}")
    return pem


def context(host: str, port: int, pin: str) -> ssl.SSLContext:
    """Returns a context that verifies the gateway, for libraries that take one."""
    context = ssl.create_default_context(cadata=pinned(host, port, pin))
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    return context
# snippet end


def ready(target: str, pem: bytes) -> bool:
    """Connects with nothing but grpcio."""
    channel = grpc.secure_channel(target, grpc.ssl_channel_credentials(root_certificates=pem))
    try:
        grpc.channel_ready_future(channel).result(3)
        return True
    except grpc.FutureTimeoutError:
        return False
    finally:
        channel.close()


def refused(address: str, code: str, **way: object) -> None:
    try:
        sgc.connect(address, timeout=3, **way).close()
    except sgc.GatewayError as error:
        assert error.code == code, error
    else:
        raise AssertionError(f"{address} was believed with {way}")


def by_grpc(ca: str, pin: str, other_pin: str, port: int, other: int, token: str) -> None:
    with open(ca, "rb") as file:
        pem = file.read()
    for host in ("localhost", "127.0.0.1"):
        assert ready(f"{host}:{port}", pem), host
        assert ready(f"{host}:{port}", pinned(host, port, pin).encode()), host
        for way in ({"ca": ca}, {"pin": pin}):
            with sgc.connect(f"grpcs://{host}:{port}", token=token, **way) as robot:
                assert next(robot.subscribe("/chatter")).data.startswith("hello ")
    assert not ready(f"localhost:{other}", pem), "a man in the middle"
    assert not ready(f"localhost:{other}", pinned("localhost", port, pin).encode())
    refused(f"grpcs://localhost:{other}", "UNAVAILABLE", ca=ca, token=token)
    refused(f"grpcs://localhost:{other}", "UNAVAILABLE", pin=pin, token=token)
    refused(f"grpcs://localhost:{port}", "UNAVAILABLE", pin=other_pin, token=token)
    for wrong in (lambda: pinned("localhost", other, pin), lambda: pinned("localhost", port, other_pin)):
        try:
            wrong()
            raise AssertionError("another key was believed")
        except ssl.SSLError:
            pass
    try:
        sgc.connect(f"grpcs://localhost:{port}", ca=ca, pin=pin)
        raise AssertionError("one of the two is enough")
    except ValueError:
        pass
    der = ssl.PEM_cert_to_DER_cert(ssl.get_server_certificate(("localhost", port)))
    for at in range(len(der) - 1):
        # Whatever is cut, there is an answer and no other failure.
        try:
            _pin.of(der[:at])
            raise AssertionError(f"{at} bytes are a certificate")
        except _pin.PinMismatch:
            pass


def by_rosbridge(port: str, other: str, token: str) -> None:
    """SSL_CERT_FILE names the CA, since roslibpy takes none."""
    import roslibpy

    headers = {"Authorization": f"Bearer {token}"}
    robot = roslibpy.Ros(f"wss://localhost:{port}", headers=headers)
    robot.run(timeout=10)
    topics = robot.get_topics()
    assert "/chatter" in topics, topics
    robot.close()
    stranger = roslibpy.Ros(f"wss://localhost:{other}", headers=headers)
    try:
        stranger.run(timeout=3)
    except roslibpy.core.RosTimeoutError:
        os._exit(0)
    raise AssertionError("a man in the middle was believed")


def by_pin_and_websocket(pin: str, port: int, other: int, token: str) -> None:
    from autobahn.asyncio.websocket import WebSocketClientFactory, WebSocketClientProtocol

    async def opens(at: int, trust: ssl.SSLContext) -> bool:
        opened = asyncio.get_running_loop().create_future()

        class Client(WebSocketClientProtocol):  # type: ignore[misc]
            def onOpen(self) -> None:
                opened.set_result(True)

        factory = WebSocketClientFactory(f"wss://localhost:{at}", headers={"Authorization": f"Bearer {token}"})
        factory.protocol = Client
        loop = asyncio.get_running_loop()
        try:
            transport, _ = await loop.create_connection(factory, "localhost", at, ssl=trust)
        except ssl.SSLCertVerificationError:
            return False
        await asyncio.wait_for(opened, 10)
        transport.close()
        return True

    trust = context("localhost", port, pin)
    assert asyncio.run(opens(port, trust))
    assert not asyncio.run(opens(other, trust)), "a man in the middle between the two connections"
    assert not asyncio.run(opens(port, ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT))), "without the certificate"


def main(ca: str, pin: str, other_pin: str, wss: str, other: str, other_wss: str, port: str, token: str) -> None:
    by_grpc(ca, pin, other_pin, int(port), int(other), token)
    by_pin_and_websocket(pin, int(wss), int(other_wss), token)
    # roslibpy's other transport, Twisted, verifies no server.
    environment = {**os.environ, "SSL_CERT_FILE": ca, "ROSLIBPY_TRANSPORT": "asyncio"}
    subprocess.run([sys.executable, "-B", __file__, "roslibpy", wss, other_wss, token], env=environment, check=True)
    print("all is well", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "roslibpy":
        by_rosbridge(*sys.argv[2:5])
    else:
        main(*sys.argv[1:9])
