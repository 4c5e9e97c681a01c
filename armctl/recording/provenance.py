"""Which program writes a log, and what is known of the clock and the port that it writes of."""

import ctypes
import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

from armctl import __version__
from armctl.clock import NS_PER_S

PACKAGE = Path(__file__).resolve().parents[1]
# What the kernel answers where nobody sets its clock (adjtimex(2): TIME_ERROR).
_UNSYNCHRONISED = 5
GIT_S = 5.0
_TIMEX_BYTES = 512  # more than the kernel fills


@cache
def program() -> dict[str, str]:
    """Versions of armctl and of what its figures depend on.

    `commit` is empty where armctl does not run from its repository; `sources` is a digest of its Python files, which
    tells a changed copy from the commit.
    """
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(f"{path.relative_to(PACKAGE)}\0".encode() + path.read_bytes())
    return {
        "version": __version__,
        "commit": commit(PACKAGE.parent) if (PACKAGE.parent / ".git").exists() else "",
        "sources": digest.hexdigest()[:16],
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "dynamixel_sdk": version("dynamixel-sdk"),
    }


def commit(root: Path) -> str:
    """The commit that is checked out in a folder; empty if there is none, or git does not tell."""
    asked = ["git", "-C", str(root), "rev-parse", "--verify", "--quiet", "HEAD"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=False, timeout=GIT_S).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def other_program(facts: Mapping[str, str]) -> str:
    """Which armctl made a log and how to run that one, as the end of a sentence; empty if it is this one.

    Args:
        facts: What the log says of itself.
    """
    ours, made_by, at = program(), facts.get("version", "unknown"), facts.get("commit", "")
    if (made_by, facts.get("sources")) == (ours["version"], ours["sources"]):
        return ""
    other = f"other sources of armctl {made_by} (commit {at or 'unknown'})"
    made = other if made_by == ours["version"] else f"armctl {made_by}, this is {ours['version']}"
    how = f"git checkout {at}" if at else f"pip install armctl=={made_by}"
    if not at and made_by == ours["version"]:  # the log is older than that logs say their commit
        begun = f"@{int(facts.get('anchor_wall_ns', 0)) // NS_PER_S}"
        how = f"git checkout $(git rev-list -1 --before={begun} HEAD), the commit of the day of the log"
    return f"; it was made by {made}: check it with that one, in an environment of its own: {how}"


def clock() -> dict[str, str]:
    """Whether somebody keeps the wall clock right now, and whether it goes on while the machine is off."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):  # another kernel, or a C library without it
        state = -1
    kept = "unknown" if state < 0 else "free" if state == _UNSYNCHRONISED else "synchronised"
    return {"clock": kept, "rtc": str(Path("/sys/class/rtc/rtc0").exists()).lower()}


def simulated(port: str) -> bool:
    """Whether a port is one that no servo can be on: a pseudo terminal, or bytes in this process."""
    return port == "loopback" or os.path.realpath(port).startswith(("/dev/pts/", "/dev/ptmx"))
