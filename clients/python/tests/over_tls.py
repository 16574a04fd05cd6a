"""The client over TLS: python over_tls.py CA IDENTITY TOKEN-FILE PORT TOKEN

CA is that of a gateway called localhost, which lets the node of IDENTITY hear /chatter, and TOKEN whatever it says.
"""

from __future__ import annotations

import sys

import sgc


def main(ca: str, identity: str, token_file: str, port: str, token: str) -> None:
    address = f"grpcs://localhost:{port}"
    # An identity file has both, the certificate and its key.
    with open(token_file, "w", encoding="ascii") as file:
        file.write(f"{token}\n")
    ways = [{"certificate": identity, "key": identity}, {"token": token}, {"token_file": token_file}]
    try:
        sgc.connect(address, ca=ca, token=token, token_file=token_file)
        raise AssertionError("one of the two is enough")
    except ValueError:
        pass
    for way in ways:
        with sgc.connect(address, ca=ca, **way) as robot:
            assert next(robot.subscribe("/chatter")).data.startswith("hello ")
    with sgc.connect(address, ca=ca, **ways[0]) as robot:
        try:
            robot.subscribe("/secret")
            raise AssertionError("the certificate does not permit it")
        except sgc.GatewayError as error:
            assert error.code == "PERMISSION_DENIED", error
    for code, way in [("UNAUTHENTICATED", {"ca": ca}), ("UNAVAILABLE", ways[1])]:
        try:
            with sgc.connect(address, timeout=2, **way) as robot:
                robot.graph()
            raise AssertionError(f"{code} was to come")
        except sgc.GatewayError as error:
            assert error.code == code, error
    with sgc.connect(f"grpcs://127.0.0.1:{port}", ca=ca, token=token, server_name="localhost") as robot:
        assert robot.graph().topics
    print("all is well", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:6])
