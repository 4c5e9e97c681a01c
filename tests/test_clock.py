"""What the clock asks of the system: precedence of the process, and of the session that is its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from armctl.clock import ask_for_precedence

ASK = """
import os
from pathlib import Path
from armctl.clock import ask_for_precedence
ask_for_precedence()
print(os.getpriority(os.PRIO_PROCESS, 0), Path("/proc/self/autogroup").read_text().split()[-1])
"""


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="this kernel weighs no sessions")
@pytest.mark.parametrize("own", [True, False], ids=["own session", "somebody else's"])
def test_a_session_of_its_own_goes_before_others(own: bool) -> None:
    """Linux weighs sessions before niceness: a daemon beside a busy login gets half of a processor."""
    before = Path("/proc/self/autogroup").read_text(encoding="ascii").split()[-1]
    command = [sys.executable, "-c", ASK]
    done = subprocess.run(command, start_new_session=own, capture_output=True, text=True, check=True, timeout=60)
    niceness, session = done.stdout.split()
    if niceness != "-10":
        pytest.skip("this user may not ask for precedence")
    assert session == ("-10" if own else before)


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="this kernel weighs no sessions")
def test_a_child_that_an_arm_waits_for_goes_before_others_from_its_start() -> None:
    child = subprocess.Popen([sys.executable, "-c", "input()"], start_new_session=True, stdin=subprocess.PIPE)
    try:
        ask_for_precedence(child.pid)
        if os.getpriority(os.PRIO_PROCESS, child.pid) != -10:
            pytest.skip("this user may not ask for precedence")
        assert Path(f"/proc/{child.pid}/autogroup").read_text(encoding="ascii").split()[-1] == "-10"
    finally:
        child.communicate(b"\n")
    ask_for_precedence(child.pid)
