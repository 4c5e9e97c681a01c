"""Guards the bytes on the wire and the tick records of the first half of 200 episodes of the soak, faults included.

`episodes.json` is made anew (see `episodes.py`) only by a commit that says why.
"""

import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from tests.guard.episodes import CHUNKS, EPISODES, FAULTS, FILE, happenings, played
from tests.guard.kept import load


@pytest.mark.parametrize("numbers", CHUNKS[: len(CHUNKS) // 2], ids=str)
def test_the_first_episodes_have_the_bytes_and_the_records_they_had(numbers: range) -> None:
    kept = load(FILE)
    assert played(numbers) == {name: kept[name] for name in (f"{number:03}" for number in numbers)}


def test_the_episodes_have_every_fault_kills_late_ticks_host_losses_and_tampering() -> None:
    often = happenings()
    assert often.keys() >= FAULTS, f"missing: {FAULTS - often.keys()}"
    assert min(often[name] for name in ("Kill", "Late", "HostGone", "Tamper")) >= 10, often
    assert len(load(FILE)) == EPISODES


@pytest.mark.parametrize("kind", ["Prescott", "Haswell", "SkylakeX"])
def test_a_hand_leads_and_a_motion_is_planned_alike_whatever_processor_numpy_is_made_for(kind: str) -> None:
    told = "import json; from tests.guard.episodes import played; print(json.dumps(played([1, 40])))"
    env = {**os.environ, "OPENBLAS_CORETYPE": kind}
    if kind == "Prescott":
        has: Any = np.show_config(mode="dicts")
        env["NPY_DISABLE_CPU_FEATURES"] = " ".join(has["SIMD Extensions"].get("found", []))
    env["PYTHONPATH"] = os.pathsep.join(sys.path)
    done = subprocess.run([sys.executable, "-c", told], env=env, capture_output=True, text=True, check=True)
    kept = load(FILE)
    assert json.loads(done.stdout) == {number: kept[number] for number in ("001", "040")}
