"""What a release is made of, as a CycloneDX 1.5 document: `python tools/packaging/sbom.py VERSION [COMMIT]` prints it.

Read from lock.txt beside this file, each package with its version and the SHA-256 of its files, and from page/, what is
bundled for the dashboard and the reports.
"""

import json
import re
import sys
from base64 import b64decode
from pathlib import Path
from typing import Any

LOCK = Path(__file__).with_name("lock.txt")
PAGE = Path(__file__).parent / "page"
PIN = re.compile(r"^([\w.-]+)==([^\s;\\]+)")
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


def locked(text: str) -> dict[str, tuple[str, list[str]]]:
    """Name -> version and hashes, in the lock's order."""
    found: dict[str, tuple[str, list[str]]] = {}
    name = ""
    for line in text.splitlines():
        if pin := PIN.match(line):
            name = pin[1]
            found[name] = pin[2], []
        if digest := HASH.search(line):
            found[name][1].append(digest[1])
    return found


def bundled() -> list[dict[str, Any]]:
    """What the libraries that pages bring along have in them."""
    lock = json.loads((PAGE / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    parts = []
    for place in json.loads((PAGE / "bundled.json").read_text(encoding="utf-8")):
        name, release = place.rpartition("node_modules/")[2], lock[place]["version"]
        ref = f"pkg:npm/{name.replace('@', '%40')}@{release}"
        digest = b64decode(lock[place]["integrity"][7:]).hex()
        hashes = [{"alg": "SHA-512", "content": digest}]
        parts.append(
            {"type": "library", "name": name, "version": release, "purl": ref, "bom-ref": ref, "hashes": hashes}
        )
    return parts


def bill(version: str, commit: str, text: str) -> dict[str, Any]:
    """The document; the same lock gives the same one."""
    parts = locked(text)
    refs = {name: f"pkg:pypi/{name}@{release}" for name, (release, _) in parts.items()}
    itself = f"pkg:pypi/armctl@{version}"
    about: dict[str, Any] = {
        "type": "application",
        "name": "armctl",
        "version": version,
        "purl": itself,
        "bom-ref": itself,
    }
    if commit:
        about["properties"] = [{"name": "commit", "value": commit}]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": about},
        "components": [
            {
                "type": "library",
                "name": name,
                "version": release,
                "purl": refs[name],
                "bom-ref": refs[name],
                "hashes": [{"alg": "SHA-256", "content": digest} for digest in digests],
            }
            for name, (release, digests) in parts.items()
        ]
        + (page := bundled()),
        "dependencies": [{"ref": itself, "dependsOn": sorted([*refs.values(), *(part["bom-ref"] for part in page)])}],
    }


if __name__ == "__main__":
    json.dump(bill(sys.argv[1], "".join(sys.argv[2:3]), LOCK.read_text(encoding="utf-8")), sys.stdout, indent=1)
    sys.stdout.write("\n")
