"""Other programs that read a log."""

import subprocess
from pathlib import Path


def told_by(*command: str | Path, folder: Path | None = None) -> str:
    """What a program says, which ends well."""
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False, cwd=folder)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
