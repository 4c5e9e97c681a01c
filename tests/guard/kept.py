"""The data files of the guard: digests by name, one a line, so that a difference names what differs."""

import hashlib
import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent


def digest(data: bytes | str) -> str:
    """A short fingerprint of bytes, or of text in UTF-8."""
    return hashlib.blake2b(data.encode() if isinstance(data, str) else data, digest_size=8).hexdigest()


def load(name: str) -> dict[str, Any]:
    """The entries of a file beside this one."""
    kept: dict[str, Any] = json.loads((FOLDER / name).read_text(encoding="utf-8"))
    return kept


def save(name: str, entries: dict[str, Any]) -> None:
    """Write a file anew; only for a commit that says why the entries changed."""
    text = json.dumps(entries, indent=1, sort_keys=True, ensure_ascii=False)
    (FOLDER / name).write_text(text + "\n", encoding="utf-8")
