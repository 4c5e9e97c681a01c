"""Plans that the daemon keeps for its clients: one JSON file each, below one folder, never overwritten."""

import re
from pathlib import Path
from typing import Any

from armctl.config import NAME_PATTERN
from armctl.errors import ConfigError, RequestRefused
from armctl.recording.disk import put
from armctl.trajectory.plan import Plan, plan_from_text

# What a list tells of a plan.
TOLD = {"via", "duration_s", "from_m", "to_m", "predicted_mean_error_mm", "predicted_max_error_mm", "arm_id"}


def save(folder: Path, name: str, text: str) -> dict[str, Any]:
    """Keep a plan under a name that is still free; the name.

    Raises:
        RequestRefused: a plan of that name exists.
        LogError: the folder cannot be written.
    """
    path = _path(folder, name)
    if path.exists():
        raise RequestRefused("EXISTS", f"a plan {name} exists; choose another name, or delete it")
    put(path, text, replacing=False)
    return {"name": name}


def load(folder: Path, name: str) -> Plan:
    """A kept plan.

    Raises:
        RequestRefused: there is none of that name.
        ConfigError: its file is no plan.
    """
    path = _path(folder, name)
    if not path.is_file():
        raise RequestRefused("NO_PLAN", f"there is no plan {name}")
    return plan_from_text(path.read_text(encoding="utf-8"), str(path))


def delete(folder: Path, name: str) -> dict[str, Any]:
    """Remove a kept plan; its name.

    Raises:
        RequestRefused: there is none of that name.
    """
    try:
        _path(folder, name).unlink()
    except FileNotFoundError:
        raise RequestRefused("NO_PLAN", f"there is no plan {name}") from None
    return {"name": name}


def listing(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Every plan that can be read, the newest first."""
    found = []
    for path in sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime_ns, reverse=True):
        try:
            plan = plan_from_text(path.read_text(encoding="utf-8"), str(path))
        except (ConfigError, OSError, UnicodeDecodeError):
            continue
        found.append({"name": path.stem, **plan.model_dump(include=TOLD)})
    return {"plans": found}


def _path(folder: Path, name: str) -> Path:
    if not re.fullmatch(NAME_PATTERN, name):  # a `$` alone lets a line end pass
        raise RequestRefused("NAME", f"{name[:80]!r} is no name; letters, digits, '.', '_', '-', at most 64")
    return folder / f"{name}.json"
