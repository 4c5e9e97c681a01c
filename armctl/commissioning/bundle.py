"""One file that answers the first questions about a bug report.

Rules.
1. Nothing is changed and no servo is written. Where a part cannot be read the file says so, and the rest is gathered.
2. Secrets are left out: values of keys that sound like one, the computer's name, the user's name and folders are
   removed from every text. Logs hold joint angles, requests and the arm's calibration, which they are wanted for.
"""

import getpass
import json
import platform
import re
import socket
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import metadata
from itertools import accumulate
from pathlib import Path

from armctl import __version__
from armctl.config import Config
from armctl.errors import ArmctlError
from armctl.files import data_dir, find_arm_file, read_text

# The newest logs, as many as fit into so much.
LOG_BYTES = 20 * 2**20
TOOL_TIMEOUT_S = 90
SECRET = re.compile(r"""(?im)^(\s*["']?[\w-]*(?:token|secret|password|key)[\w-]*["']?\s*[:=]\s*).+$""")

# Home folders, and ports by a name that holds the adapter's serial number.
PRIVATE_PATH = re.compile(r"/(?:home|run/user)/[^/\s\"']+|/dev/serial/[^\s\"',]+")


def write(path: Path, config: Config, config_file: str, logs: Path | None, tell: Callable[[str], None]) -> list[str]:
    """Gather everything into a new zip file.

    Args:
        path: The file; it must not exist.
        config_file: What `--config` named, or nothing.
        logs: Where the daemon keeps its logs; None: where one of this user would.
        tell: Called with the name of each part before it is gathered.
    Returns:
        Names of the files inside.
    Raises:
        ArmctlError: the file exists or cannot be written.
    """
    try:
        with zipfile.ZipFile(path, "x", zipfile.ZIP_DEFLATED) as archive:
            for name, gather in _texts(config, config_file):
                tell(name)
                archive.writestr(name, redacted(gather()))
            for log in newest_logs(logs or data_dir(config) / "logs"):
                tell(log.name)
                archive.write(log, f"logs/{log.name}")
            return archive.namelist()
    except FileExistsError:
        raise ArmctlError(f"{path} exists; name another file with --out") from None
    except OSError as error:
        raise ArmctlError(f"{path}: cannot be written: {error.strerror}; name another file with --out") from None


def _texts(config: Config, config_file: str) -> Iterator[tuple[str, Callable[[], str]]]:
    options = ("--config", config_file) if config_file else ()
    yield "versions.json", versions
    yield "configuration.json", lambda: config.model_dump_json(indent=1)
    yield "calibration.yaml", lambda: _read_calibration(config.arm)
    yield "status.json", lambda: _said((sys.executable, "-m", "armctl", "status", "--json"))
    yield "doctor.json", lambda: _said((sys.executable, "-m", "armctl", "doctor", "--json", *options))
    yield "journal.txt", lambda: _said(("journalctl", "--unit=armctl", "--lines=2000", "--no-pager", "--no-hostname"))


def versions() -> str:
    """armctl, Python, the system, and every package armctl may use."""
    installed = {}
    for name in sorted({re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in metadata.requires("armctl") or ()}):
        with suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    facts = {"armctl": __version__, "python": sys.version, "system": platform.platform(), "packages": installed}
    return json.dumps(facts, indent=1)


def _read_calibration(arm: str) -> str:
    try:
        return read_text(find_arm_file(arm), "calibration")
    except ArmctlError as error:
        return f"# cannot be read: {error}\n"


def _said(command: tuple[str, ...]) -> str:
    """What a command printed, on either channel."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TOOL_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"cannot be run: {error}\n"
    return done.stdout + done.stderr


def newest_logs(folder: Path) -> list[Path]:
    """The newest logs, and what a crash left unfinished, as many as fit into `LOG_BYTES`."""
    logs = sorted(folder.glob("*.mcap*"), key=lambda log: (log.stat().st_mtime_ns, log), reverse=True)
    sizes = accumulate(log.stat().st_size for log in logs)
    return [log for log, size in zip(logs, sizes, strict=True) if size <= LOG_BYTES]


def redacted(text: str) -> str:
    """The text without the values of secret-sounding keys, the computer's and the user's names, folders and port."""
    text = SECRET.sub(r"\1(left out)", text)
    text = PRIVATE_PATH.sub("~", text.replace(str(Path.home()), "~"))
    host = socket.gethostname()
    text = re.sub(rf"\b{re.escape(host)}\b", "(host)", text) if len(host) > 2 else text
    user = getpass.getuser()
    return re.sub(rf"\b{re.escape(user)}\b", "(user)", text) if len(user) > 2 and user != "root" else text
