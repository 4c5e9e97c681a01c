"""Paths of the tool through the host, on simulated servos in virtual time; judged by the simulator's true tool."""

import asyncio
import math
import re
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl.host.motions import path
from armctl.kinematics.transform import FloatArray
from armctl.messages import Mode, TickRecord
from armctl.trajectory.tool_path import Outline, PathRequest
from tests.control.ideal_arm import PERIOD_S
from tests.host.simulated import SimulatedBench, on_arm

HEIGHT_M = 0.1


def square(side_m: float = 0.1, near_m: float = 0.13) -> PathRequest:
    far_m, half_m = near_m + side_m, side_m / 2.0
    corners = ((near_m, -half_m), (far_m, -half_m), (far_m, half_m), (near_m, half_m), (near_m, -half_m))
    return PathRequest(points_m=tuple((x, y, HEIGHT_M) for x, y in corners))


def circle(radius_m: float = 0.03, middle_m: float = 0.2) -> PathRequest:
    angles = np.linspace(0.0, 2.0 * math.pi, 5)
    points = tuple((middle_m + radius_m * math.cos(a), radius_m * math.sin(a), HEIGHT_M) for a in angles)
    return PathRequest(points_m=points, kinds=("line", "through", "arc", "through", "arc"))


class Truth:
    """Where the tool truly is, at each tick, from when a motion begins until it ends."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.points: list[FloatArray] = []
        self._bench, self._inside = bench, False
        bench.on_tick = self.see

    def see(self, record: TickRecord) -> None:
        codes = {event.code for event in record.outputs.events}
        self._inside |= "PLAN_BEGIN" in codes
        if self._inside:
            self.points.append(self._bench.simulated.true_tool_position())
        self._inside &= "PLAN_END" not in codes


async def followed(
    bench: SimulatedBench, work: Coroutine[Any, Any, dict[str, Any]]
) -> tuple[dict[str, Any], FloatArray]:
    """What a motion answers, and the true tool points [m] meanwhile, shape (m, 3)."""
    truth = Truth(bench)
    result = await bench.served(work)
    bench.on_tick = lambda _: None
    return result, np.array(truth.points)


def off_mm(true: FloatArray, request: PathRequest) -> FloatArray:
    """How far true tool points are from the nearest of the path that was asked for."""
    outline = Outline(request)
    points = outline.sharp(np.linspace(0.0, outline.length_m, 4001))
    return np.asarray(1e3 * np.linalg.norm(true[:, None] - points, axis=2).min(axis=1))


# --------------------------------------------------------------------------------------------------- path


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("request_", [square(), circle()], ids=["square", "circle"])
async def test_the_tool_follows_a_path_of_lines_and_of_arcs(request_: PathRequest, seed: int) -> None:
    async with on_arm("ax12-line", seed) as bench:
        result, true = await followed(bench, path(bench.host, bench.anna, request_))
        off = off_mm(true, request_)
        assert off.mean() <= 1.2
        assert off.max() < 4.0
        assert 0.0 < result["mean_error_mm"] < 1.6
        assert list(bench.recorder.takes) == [result["recording"]]
        assert Mode.FAULTED not in bench.modes


async def test_a_corner_is_missed_by_its_tolerance_and_what_the_arm_adds() -> None:
    async with on_arm("ax12-line", 1) as bench:
        result, true = await followed(bench, path(bench.host, bench.anna, square()))
        assert result["predicted_max_error_mm"] == pytest.approx(math.sqrt(2.0), abs=0.05), "by 2 mm along the diagonal"
        assert 0.0 < result["predicted_mean_error_mm"] < 0.1
        for corner in square().points_m[1:4]:
            assert 1e3 * np.linalg.norm(true - corner, axis=1).min() < 2.0 + 1.5


async def test_a_path_takes_as_long_as_was_asked_for_and_replays_bit_for_bit(tmp_path: Path) -> None:
    async with on_arm("ax12-line", 1) as bench:
        asked = circle().model_copy(update={"duration_s": 6.0})
        result = await bench.served(path(bench.host, bench.anna, asked))
        assert result["duration_s"] == pytest.approx(6.0, abs=1.5 * PERIOD_S)
        checked = bench.replayed(tmp_path / "path.mcap")
        assert checked.mismatches == 0
        assert any('"event": "PATH"' in note for note in bench.recorder.notes)


@pytest.mark.parametrize(
    ("asked", "code", "match"),
    [
        (circle(radius_m=0.25), "PATH", "out of reach; the nearest point"),
        (square(near_m=0.3), "PATH", "mm along the path, is .* out of reach"),
        (circle().model_copy(update={"duration_s": 0.5}), "PREFLIGHT", r"too short for it; give \d+\.\d s or more"),
        (PathRequest(points_m=((0.2, 0.0, 0.05), (0.2, 0.0, -0.05))), "PATH", "below the floor"),
    ],
)
async def test_a_path_that_cannot_be_followed_is_refused_before_anything_moves(
    asked: PathRequest, code: str, match: str
) -> None:
    async with on_arm("ax12-line") as bench:
        error = await bench.refused(path(bench.host, bench.anna, asked), code)
        assert re.search(match, str(error))
        assert Mode.MOVING not in bench.modes
        assert not bench.recorder.takes


async def test_a_client_that_leaves_while_its_path_is_followed_stops_the_arm() -> None:
    async with on_arm("ax12-line", 1) as bench:
        task = asyncio.create_task(path(bench.host, bench.anna, circle()))
        await bench.until(lambda: Mode.MOVING in bench.modes)
        bench.host.client_gone(bench.anna)
        await bench.refused(task, "STOPPED")
