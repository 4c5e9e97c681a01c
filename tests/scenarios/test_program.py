"""A program behind a real daemon that is killed in the middle of it: the next one goes on where it stood."""

import json
from typing import Any

import pytest
import yaml

from armctl.errors import NoDaemon
from armctl.recording import replay
from tests.scenarios.bench import Bench, Simulator, armctl

pytestmark = pytest.mark.pty


def test_a_program_goes_on_after_its_daemon_was_killed_and_its_recordings_replay(
    holding: Bench, arm: Simulator
) -> None:
    here = [joint["position_rad"] for joint in holding.client().call("status")["joints"]]

    def turned(by_rad: float) -> dict[str, Any]:
        return {"move": {"joints_rad": [round(q, 5) for q in (here[0] + by_rad, *here[1:])], "duration_s": 1.5}}

    steps = [turned(0.1), {"name": "twice", "repeat": {"times": 2, "steps": [turned(0.2), turned(0.3)]}}, turned(0.0)]
    file = holding.folder / "to-and-fro.yaml"
    file.write_text(yaml.safe_dump({"steps": steps}))
    checked = armctl(holding.folder, "program", "check", str(file), "--json", "--socket", str(holding.socket))
    assert checked.returncode == 0, checked.stdout
    assert [row["name"] for row in json.loads(checked.stdout)["steps"]] == ["1", "twice.1", "twice.2", "3"]

    client, begun = holding.client(), []

    def killed(told: dict[str, Any]) -> None:
        begun.append(told["step"])
        if told["step"] == "twice.2@1":
            holding.daemons[-1].kill()

    with pytest.raises(NoDaemon):
        client.call("program_run", name=file.stem, steps=steps, on_progress=killed)
    assert begun[-1] == "twice.2@1"
    holding.start_daemon()
    holding.until(lambda snapshot: snapshot["state"] == "holding")
    ran = armctl(holding.folder, "program", "run", str(file), "--json", "--socket", str(holding.socket))
    result = json.loads(ran.stdout)
    assert ran.returncode == 0, result
    assert result["resumed_at"] == "twice.2@1"
    assert [row["name"] for row in result["steps"]] == ["twice.2@1", "twice.1@2", "twice.2@2", "3"]
    assert "step twice.2@1: the program begins here; `--from 1` begins anew" in ran.stderr
    assert arm.client.state()["joints_rad"][0] == pytest.approx(here[0], abs=0.05)
    assert holding.daemons[-1].end() == 0
    recorded = sorted(holding.recordings.glob("run-program-to-and-fro-*.mcap"))
    assert len(recorded) == 2
    for path in recorded:
        found = replay.check(path)
        assert (found.mismatches, found.first_mismatch) == (0, "")
        assert found.ticks > 0
