"""The whole job on every arm with a gripper, in virtual time: taught, played, refined, sent, gripping, and parked.

Judged by the simulator's truth. The line is the one that the demonstration takes on this arm.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from armctl.files import load_arm
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.host.motions import move, play, run
from armctl.host.reach import reach
from armctl.host.refining import refine
from armctl.lab.demo import line_in_reach
from armctl.messages import Mode
from armctl.trajectory.grasp import ReachRequest
from armctl.trajectory.plan import plan_from_text
from armctl.trajectory.playback import PlayRequest
from armctl.trajectory.straightness import errors_mm
from armctl.trajectory.target import MoveRequest
from tests.host.simulated import SimulatedBench, on_arm
from tests.host.test_following import by_hand, due_m, followed
from tests.mounted import mounted

ARMS = ("crane-plus-v2", "crustcrawler", "phantomx-pincher", "phantomx-reactor", "xiang-6dof")
# Arms whose zero offsets, which no encoder shows, are neither the largest nor the smallest.
SEED = 1
FEW_TICKS_DEG = 4.0
Point = tuple[float, float, float]


def ends(name: str) -> tuple[Point, Point]:
    found = line_in_reach(load_arm(name))
    assert found is not None
    return found


def between(name: str, share: float) -> Point:
    A, B = np.array(ends(name))
    x, y, z = (A + share * (B - A)).tolist()
    return x, y, z


@pytest.mark.parametrize("name", ARMS)
async def test_an_arm_is_taught_plays_and_refines_a_line(name: str, tmp_path: Path) -> None:
    (A, B), plan_file = ends(name), tmp_path / "plans"
    async with on_arm(name, SEED) as bench:
        takes = [await by_hand(bench, seed, (A, B)) for seed in range(3)]
        take, taught_m = takes[0]
        await bench.served(bench.host.command(bench.anna, "park"))
        await bench.served(bench.host.command(bench.anna, "torque_on"))

        _, true_m = await followed(bench, play(bench.host, bench.anna, take.model_copy, PlayRequest(motion=take)))
        assert (1e3 * np.linalg.norm(true_m - due_m(take, taught_m, 1.0, len(true_m)), axis=1)).mean() < 2.5

        asked = OptimizeRequest(from_m=A, to_m=B, duration_s=5.0, via=(2,), seed=SEED)
        plans = optimize([np.array(one.positions_rad) for one, _ in takes], bench.arm, bench.robot, asked).plans
        refined = await bench.served(refine(bench.host, bench.anna, plans[0], 3, plan_file))
        assert refined["ended"] is None
        kept = plan_from_text(Path(refined["plan"]).read_text(encoding="utf-8"), refined["plan"])
        _, true_m = await followed(bench, run(bench.host, bench.anna, kept))
        mean_mm, max_mm = errors_mm(true_m, np.array(A), np.array(B))
        assert (mean_mm < 2.5, max_mm < 5.0) == (True, True), (mean_mm, max_mm)
        assert Mode.FAULTED not in bench.modes


@pytest.mark.parametrize("name", ARMS)
async def test_an_arm_goes_where_it_is_sent_grips_lets_go_and_parks(name: str) -> None:
    async with on_arm(name, SEED) as bench:
        off = bench.off_mm
        for share in (0.1, 0.9, 0.5):
            point = between(name, share)
            await bench.served(move(bench.host, bench.anna, MoveRequest(point_m=point)))
            assert off(point) < 3.0
        await gripped_and_let_go(bench, between(name, 0.3))
        assert await bench.served(bench.host.command(bench.anna, "park")) == {"state": "off"}
        assert bench.true_deg() == pytest.approx([joint.rest_deg for joint in bench.arm.joints], abs=FEW_TICKS_DEG)
        assert Mode.FAULTED not in bench.modes


@pytest.mark.parametrize(("name", "A", "B"), [
    ("hanging", (0.15, -0.07, 0.25), (0.15, 0.07, 0.25)),
    ("beside", (0.422, -0.354, 0.15), (0.506, -0.242, 0.15)),
])  # fmt: skip
async def test_an_arm_that_hangs_or_stands_elsewhere_does_the_whole_job(
    name: str, A: Point, B: Point, tmp_path: Path
) -> None:
    async with on_arm(mounted(tmp_path, name), SEED) as bench:
        takes = [(await by_hand(bench, seed, (A, B)))[0] for seed in range(2)]
        await bench.served(bench.host.command(bench.anna, "park"))
        await bench.served(bench.host.command(bench.anna, "torque_on"))
        asked = OptimizeRequest(from_m=A, to_m=B, duration_s=5.0, via=(2,), seed=SEED)
        plans = optimize([np.array(one.positions_rad) for one in takes], bench.arm, bench.robot, asked).plans
        refined = await bench.served(refine(bench.host, bench.anna, plans[0], 3, tmp_path))
        kept = plan_from_text(Path(refined["plan"]).read_text(encoding="utf-8"), refined["plan"])
        _, true_m = await followed(bench, run(bench.host, bench.anna, kept))
        mean_mm, max_mm = errors_mm(true_m, np.array(A), np.array(B))
        assert (mean_mm < 2.5, max_mm < 5.0) == (True, True), (mean_mm, max_mm)
        for point in (A, B):
            await bench.served(move(bench.host, bench.anna, MoveRequest(point_m=point)))
            assert bench.off_mm(point) < 3.0
        await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=A, off_m=0.02)))
        assert bench.off_mm(A) < 4.0
        assert await bench.served(bench.host.command(bench.anna, "park")) == {"state": "off"}
        assert bench.true_deg() == pytest.approx([joint.rest_deg for joint in bench.arm.joints], abs=FEW_TICKS_DEG)
        assert Mode.FAULTED not in bench.modes


async def gripped_and_let_go(bench: SimulatedBench, point: Point) -> None:
    gripper = bench.arm.gripper
    assert gripper is not None
    at_deg = (gripper.open_deg + gripper.closed_deg) / 2.0
    take_away = bench.place_object(math.radians(at_deg))
    held = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=point, gripper="grip", off_m=0.03)))
    assert held["gripped"] is True
    assert held["gripper"]["position_rad"] == pytest.approx(math.radians(at_deg), abs=math.radians(3.0))
    assert held["position_error_mm"] < 4.0
    take_away()
    let = await bench.served(reach(bench.host, bench.anna, ReachRequest(point_m=point, gripper="let_go", off_m=0.03)))
    assert math.degrees(let["gripper"]["position_rad"]) == pytest.approx(gripper.open_deg, abs=3.0)
