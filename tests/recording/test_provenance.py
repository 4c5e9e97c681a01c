"""What a log says of the program, the clock and the port behind it."""

import os
import platform
import pty
import subprocess
from pathlib import Path

import numpy as np
import pytest

from armctl import __version__
from armctl.recording import provenance, reader
from tests.recording.factory import make_records
from tests.recording.logs import write


def git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_every_file_says_which_program_wrote_it_and_by_which_clock(tmp_path: Path) -> None:
    facts = reader.info(write(tmp_path / "a.mcap", make_records(3))).facts
    assert (facts["version"], facts["python"]) == (__version__, platform.python_version())
    assert facts["numpy"] == np.__version__
    assert facts["dynamixel_sdk"]
    assert len(facts["sources"]) == 16
    assert facts["clock"] in ("synchronised", "free", "unknown")
    assert facts["rtc"] in ("true", "false")
    assert facts["simulated"] == "false"


@pytest.mark.parametrize("packed", [False, True])
def test_the_commit_is_that_of_the_folder_in_every_work_tree(tmp_path: Path, packed: bool) -> None:
    main, other = tmp_path / "main", tmp_path / "other"
    main.mkdir()
    assert provenance.commit(main) == ""
    git(main, "init", "-q", "-b", "trunk")
    assert provenance.commit(main) == ""
    git(main, "commit", "-q", "--allow-empty", "-m", "first")
    git(main, "worktree", "add", "-q", "-b", "branch", str(other))
    git(other, "commit", "-q", "--allow-empty", "-m", "second")
    if packed:
        git(main, "pack-refs", "--all")
    assert provenance.commit(main) == git(main, "rev-parse", "HEAD")
    assert provenance.commit(other) == git(other, "rev-parse", "HEAD") != provenance.commit(main)
    git(other, "checkout", "-q", "--detach")
    assert provenance.commit(other) == git(other, "rev-parse", "HEAD")


def test_a_pseudo_terminal_has_no_servos_whatever_link_leads_to_it(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    try:
        (tmp_path / "arm").symlink_to(os.ttyname(theirs))
        assert provenance.simulated(os.ttyname(theirs))
        assert provenance.simulated(str(tmp_path / "arm"))
    finally:
        os.close(ours)
        os.close(theirs)
    assert provenance.simulated("loopback")
    assert not provenance.simulated("/dev/ttyUSB0")
