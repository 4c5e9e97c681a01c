"""The straight-line experiment as a whole, on simulated arms."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from armctl.config import Config
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.lab import sag_identification
from armctl.lab.line_experiment import Asked, on_virtual_arm
from armctl.lab.rig import VirtualRig
from armctl.lab.stage import silent
from armctl.sim.arm import SimulatedArm
from tests.mounted import mounted

ARM = load_arm("phantomx-pincher")
# Its candidates end low at the side, the shoulder at its limit: from there each way to a calibration line, as that to
# rest, dips below the table or is too heavy.
LOW = Asked(
    from_m=(0.187, 0.004, 0.151),
    to_m=(0.125, -0.202, 0.06),
    via=(2,),
    rounds=2,
    seed=3,
    recordings=(),
    profile="default",
    measured=None,
    report=None,
)


def test_an_arm_that_a_hand_left_where_it_cannot_set_off_is_at_rest_again_before_it_is_measured() -> None:
    found = on_virtual_arm(ARM, LOW, 0.1, Config(), silent)
    [row], ga = found["rows"], found["ga"]
    assert len(ga["baseline"]) == 5, "all candidates were guided"
    assert row["truth"]["mean_error_mm"] < 1.5
    assert row["truth"]["max_error_mm"] < 3.5
    assert row["truth"]["mean_error_mm"] < 0.2 * found["before"][0]["truth"]["mean_error_mm"]


def test_an_arm_that_can_run_no_calibration_line_says_why() -> None:
    rig = VirtualRig(SimulatedArm(ARM, seed=3))
    rig.arm = ARM.model_copy(update={"tool_speed_limit_m_s": 0.01})
    with (
        patch.object(sag_identification, "MOST_TRIES", 2),
        pytest.raises(RequestRefused, match=r"only 0 of 8 .* not: no way along the line is slow enough") as refused,
    ):
        sag_identification.identify(rig, np.random.default_rng(0))
    assert refused.value.code == "CALIBRATE"


@pytest.mark.parametrize(("name", "A", "B"), [
    ("hanging", (0.15, -0.07, 0.25), (0.15, 0.07, 0.25)),
    ("beside", (0.422, -0.354, 0.15), (0.506, -0.242, 0.15)),
])  # fmt: skip
def test_a_line_of_an_arm_that_hangs_or_stands_elsewhere_becomes_straight(
    name: str, A: tuple[float, float, float], B: tuple[float, float, float], tmp_path: Path
) -> None:
    """Calibration lines are drawn about the arm's own axis; before, none fitted the one beside its root link."""
    arm = load_arm(mounted(tmp_path, name))
    found = on_virtual_arm(arm, replace(LOW, from_m=A, to_m=B), 0.1, Config(), silent)
    [row] = found["rows"]
    assert row["truth"]["mean_error_mm"] < 1.2
    assert row["truth"]["max_error_mm"] < 3.0
    assert row["truth"]["mean_error_mm"] < 0.3 * found["before"][0]["truth"]["mean_error_mm"]
