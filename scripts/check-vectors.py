#!/usr/bin/env python3
"""Computes the golden values of names, identities, tokens and codes with Python's library alone, and checks that each of
them is the one that a test of `sgc-trust` expects. (Those of sealing, signing and grants are `trust-vectors.py`'s.)"""

import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
CRATE = ROOT / "crates" / "sgc-trust"


def expected() -> str:
    return joined("".join(path.read_text() for path in sorted(CRATE.rglob("*.rs"))))


def joined(source: str) -> str:
    """Puts constants together that are written in pieces."""
    return re.sub(r'",\n\s*"', "", source)


def printed(script: str, *args: str) -> list[str]:
    command = [sys.executable, "-B", str(ROOT / "scripts" / script), *args]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [line.split()[-1] for line in lines if line.strip()]


def main() -> None:
    sources = expected()
    ca = re.search(r'"(MII[A-Za-z0-9+/=]+)"', joined((CRATE / "tests/tokens.rs").read_text()))
    if ca is None:
        sys.exit("tests/tokens.rs: no CA to make a token with")
    values = printed("name-vectors.py") + printed("pki-vectors.py")
    values += printed("token-vector.py", ca.group(1)) + printed("join-code-vector.py", ca.group(1))
    unknown = [value for value in values if value not in sources]
    if unknown or len(values) < 14:
        sys.exit(f"of {len(values)} values no test expects: {unknown}")
    print(f"{len(values)} golden values of names, identities, tokens and codes agree")


main()
