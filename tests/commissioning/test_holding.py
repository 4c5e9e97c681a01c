"""What touches of an arm that stands by itself tell of it, judged by where its tool truly is."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armctl.commissioning import holding
from armctl.commissioning.calibration import Touch
from armctl.commissioning.holding import Way
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.solution import solve
from armctl.kinematics.target import pose_target
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.geometry import Draws
from armctl.sim.gravity import PointMasses
from armctl.sim.spec import GEOMETRIES, ArmSpec, put_together
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.preflight import DrivenArm, preflight_motion
from tests.commissioning.bench import postures
from tests.host.doubles import refused
from tests.mounted import mounted

ARM = load_arm("ax12-line")
ARMS = ("ax12-line", "phantomx-pincher", "crane-plus-v2", "phantomx-reactor", "xiang-6dof")


def ticks_at(arm: ArmConfig, q: Sequence[float]) -> tuple[float, ...]:
    return tuple(joint.tick(position) for joint, position in zip(arm.joints, q, strict=True))


def tool_by(arm: ArmConfig, ticks: FloatArray) -> FloatArray:
    """Where a file has the tool [m] when its servos read so, shape (m, joints)."""
    chain = robots.of(arm).chain
    q = [[joint.position_rad(tick) for joint, tick in zip(arm.joints, row, strict=True)] for row in ticks]
    return tool_position(chain, np.array(q)[:, : chain.n])


def touches_of(ticks: FloatArray, points: FloatArray) -> list[Touch]:
    return [Touch(point_m=tuple(p), ticks=tuple(t)) for t, p in zip(ticks.tolist(), points.tolist(), strict=True)]


@pytest.mark.parametrize("name", ARMS)
def test_the_table_of_an_arm_is_its_chain(name: str) -> None:
    arm, rng = load_arm(name), np.random.default_rng(0)
    chain = robots.of(arm).chain
    waves, bends = 0.01 * rng.standard_normal((chain.n, 4)), 0.01 * rng.standard_normal(chain.n)
    soft = zip(chain.rows, waves.tolist(), bends.tolist(), strict=True)
    chain = replace(chain, rows=tuple(replace(row, waves=tuple(four), bend=bend) for row, four, bend in soft))
    chain = replace(
        chain, tool=replace(chain.tool, bend=0.02 * (chain.convention == "modified")), base_m=(0.1, 0.0, 0.5)
    )
    again = robots.of(ArmConfig.model_validate(arm.model_dump(mode="json", exclude={"lengths_m"}) | {
        "robot": holding.table_of(chain)})).chain  # fmt: skip
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (50, chain.n))
    np.testing.assert_allclose(forward_kinematics(again, q), forward_kinematics(chain, q), atol=1e-6)
    assert again.base_m == chain.base_m


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("seed", range(3))
def test_what_is_off_within_the_priors_is_found_and_its_deviation_is_true(name: str, seed: int) -> None:
    arm, rng = load_arm(name), np.random.default_rng(seed)
    chain = robots.of(arm).chain
    n = chain.n
    # By a chain put together here, whose zeros are the offsets of its rows.
    rows = [
        replace(row, a=row.a + 1e-3 * d[0], d=row.d + 1e-3 * d[1], alpha=row.alpha + math.radians(d[2]))
        for row, d in zip(chain.rows, rng.standard_normal((n, 3)), strict=True)
    ]
    off = np.radians(rng.standard_normal(n))
    true = replace(chain, rows=tuple(replace(row, offset=row.offset + o) for row, o in zip(rows, off, strict=True)))
    q = np.concatenate([postures(arm, 24, rng), postures(arm, 60, rng)])
    points = tool_position(true, q[:, :n])
    ticks = np.array([ticks_at(arm, row) for row in q])
    said = points[:24] + 0.5e-3 / math.sqrt(3.0) * rng.standard_normal((24, 3))
    found = holding.fit(arm, touches_of(ticks[:24], said))
    off_mm, was_mm = (
        1e3 * np.linalg.norm(tool_by(one, ticks[24:]) - points[24:], axis=1).mean() for one in (found.arm, arm)
    )
    assert off_mm < 0.7 < was_mm
    assert found.held_out_mm == pytest.approx(off_mm, abs=0.6)
    assert found.after_mm < found.held_out_mm < found.before_mm
    moved = [*(-joint.direction * o * 1023 / math.radians(300) for joint, o in zip(arm.joints, off, strict=False))]
    zeros = zip(found.parameters, arm.joints, moved, strict=False)
    apart = [(one["value"] - joint.zero_tick - tick) / one["sd"] for one, joint, tick in zeros]
    assert np.abs(apart).max() < 4.0
    assert [one["name"] for one in found.parameters[:n]] == [f"{joint.name}.zero_tick" for joint in arm.joints[:n]]


def over_a_sheet(count: int, rng: np.random.Generator) -> FloatArray:
    """Postures whose tool is over a sheet ahead of the arm, at most 150 mm above it, shape (m, joints)."""
    low, high = np.array([joint.limits_rad for joint in ARM.joints]).T
    q = rng.uniform(low, high, (300 * count, len(ARM.joints)))
    x, y, z = tool_position(robots.of(ARM).chain, q[:, :5]).T
    found = q[(x > 0.1) & (x < 0.26) & (np.abs(y) < 0.14) & (z > 0.0) & (z < 0.15)][:count]
    assert len(found) == count
    return np.asarray(found)


def true_tool(arm: SimulatedArm, geometry: str, q: FloatArray, seed: int) -> FloatArray:
    """Where the tool truly is [m], shape (m, 3), when the servos hold the joints at q: brackets bend by the weight."""
    draws = Draws(GEOMETRIES[geometry], seed)
    off = np.array([draws.zero_rad() for _ in range(5)])
    bends = [draws.deviation(0.0) for _ in range(5)]
    masses = PointMasses(arm.chain, arm.points_kg)
    links = []
    for row in q[:, :5] + off:
        for bend, angle, (load_Nm, _) in zip(bends, row.tolist(), masses.loads(row.tolist()), strict=True):
            bend.settle(angle, load_Nm)
        links.append([angle + bend.settled_rad for angle, bend in zip(row.tolist(), bends, strict=True)])
    return tool_position(arm.chain, np.array(links))


def assert_found(arm: ArmConfig, ticks: FloatArray) -> None:
    """Inverse kinematics finds the way back to where the tool is."""
    robot, limits = robots.of(arm), np.array([joint.limits_rad for joint in arm.joints[:5]])
    q = np.array([[joint.position_rad(tick) for joint, tick in zip(arm.joints, row, strict=True)] for row in ticks])
    for one in q[:, : robot.chain.n]:
        T = forward_kinematics(robot.chain, one)
        best = solve(robot, pose_target(T), limits=limits).solutions[0]
        np.testing.assert_allclose(forward_kinematics(robot.chain, np.array(best.q_rad)), T, atol=1e-6)


@pytest.mark.parametrize(("geometry", "bound_mm"), [("careful", 1.1), ("typical", 1.5), ("poor", 2.5)])
def test_an_arm_put_together_by_hand_is_where_it_is_told_to_be_afterwards(geometry: str, bound_mm: float) -> None:
    off_mm, was_mm, told_mm = list[float](), list[float](), list[float]()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        arm = SimulatedArm(ARM, seed=seed, spec=put_together(ArmSpec(), geometry, "new"))
        q = over_a_sheet(84, rng)
        ticks = np.array([ticks_at(ARM, row) for row in q]) + 0.3 * rng.standard_normal(q.shape)
        points = true_tool(arm, geometry, q, seed)
        said = points[:24] + 0.5e-3 / math.sqrt(3.0) * rng.standard_normal((24, 3))
        found = holding.fit(ARM, touches_of(ticks[:24], said))
        assert_found(found.arm, ticks[24:30])
        for mm, one in ((off_mm, found.arm), (was_mm, ARM)):
            mm.append(1e3 * np.linalg.norm(tool_by(one, ticks[24:]) - points[24:], axis=1).mean())
        told_mm.append(found.held_out_mm)
    assert np.median(off_mm) < min(bound_mm, 0.6 * float(np.median(was_mm)))
    assert np.median(told_mm) == pytest.approx(np.median(off_mm), abs=0.5)


def information(J: FloatArray, sd: FloatArray) -> FloatArray:
    return np.asarray(np.diag(sd**-2.0) + J.T @ J / holding.TOUCH_M**2)


def test_ways_come_in_the_order_in_which_a_touch_makes_the_determinant_greatest() -> None:
    rng, chain = np.random.default_rng(0), robots.of(ARM).chain
    q = postures(ARM, 24, rng)
    sd, x = holding._sd(chain), np.zeros(9 * chain.n)
    slopes = [holding._slopes(chain, row[None, : chain.n], x) for row in q]
    touches = touches_of(np.array([ticks_at(ARM, row) for row in q[:4]]), np.zeros((4, 3)))
    ways = [Way(k, (0.0, 0.0, 0.0), 0, tuple(row[: chain.n])) for k, row in enumerate(q.tolist())][4:]
    sizes = [np.linalg.slogdet(information(np.concatenate([*slopes[:4], slopes[way.number]]), sd))[1] for way in ways]
    assert holding.most_telling(ARM, touches, ways) == [ways[i] for i in np.argsort(sizes)[::-1]]
    first = holding.most_telling(ARM, [], ways)[0]
    alone = [np.linalg.slogdet(information(slopes[way.number], sd))[1] for way in ways]
    assert first is ways[int(np.argmax(alone))]


def limp_ways(points: int, times: int) -> list[Way]:
    """Ways to points wherever a hand holds the limp arm."""
    return [Way(number, (0.1 * number, 0.0, 0.0), k) for number in range(1, points + 1) for k in range(times)]


TICKS = ticks_at(ARM, [0.0] * 6)


def test_a_point_is_left_until_it_was_touched_so_often_or_is_skipped() -> None:
    ways = limp_ways(3, 3)
    assert holding.left(ways, [], (), 2) == ways
    assert holding.left(ways, ways[:1], {3}, 2) == [*ways[1:3], *ways[3:6]]
    assert holding.left(ways, [ways[0], ways[2]], {3}, 2) == ways[3:6]


def test_touches_of_an_earlier_session_count_as_made() -> None:
    points = [(0.1, 0.0, 0.0), (0.2, 0.0, 0.0), (0.3, 0.0, 0.0)]
    ways = limp_ways(3, 2)
    before = [Touch(point_m=points[1], ticks=TICKS)] * 3 + [Touch(point_m=points[0], ticks=TICKS)]
    made = holding.begun(ARM, before, ways, points)
    assert [*made.values()] == before, "more than were asked for are kept"
    assert [(way.number, way.posture) for way in holding.left(ways, made, (), 2)] == [(1, 1), (3, 0), (3, 1)]
    with refused("POINTS", "touch 2 of the readings is at 0.2000, 0.0000, 0.0000 m, where the sheet has no point"):
        holding.begun(ARM, [*before[3:], *before], ways, points[:1])


def test_a_posture_that_was_touched_before_is_not_asked_for_again() -> None:
    places = [(0.22, 0.0, 0.0)]
    ways = holding.ways_above(ARM, places, 0.03)
    assert len(ways) > 1
    near = Touch(point_m=places[0], ticks=ticks_at(ARM, [angle + 0.05 for angle in (*ways[1].q_rad, 0.0)]))
    assert holding.begun(ARM, [near], ways, places) == {ways[1]: near}


def test_a_touch_whose_tip_is_far_from_its_point_is_refused_unless_the_arm_is_limp() -> None:
    [way, *_] = holding.ways_above(ARM, [(0.22, 0.0, 0.0)], 0.041)
    with refused("FAR", "the tip is 41 mm from point 1 by the arm's file, at most 25 mm; lead it nearer, or press s"):
        holding.touch_by(ARM, way, ticks_at(ARM, (*way.q_rad, 0.0)))
    [near, *_] = holding.ways_above(ARM, [(0.22, 0.0, 0.0)], 0.024)
    for one in (near, way._replace(q_rad=())):
        taken = holding.touch_by(ARM, one, ticks := ticks_at(ARM, (*near.q_rad, 0.0)))
        assert taken == Touch(point_m=(0.22, 0.0, 0.0), ticks=ticks)


def test_ways_above_a_point_bring_the_tool_there_and_none_leads_out_of_reach_or_through_the_table() -> None:
    points = [(0.2, 0.05, 0.0), (0.9, 0.0, 0.0), (0.2, -0.1, 0.06), (0.0, 0.0, 0.0), (0.2, 0.0, -0.05)]
    ways = holding.ways_above(ARM, points, 0.03)
    assert {way.number for way in ways} == {1, 3}
    assert len({(way.number, way.posture) for way in ways}) == len(ways) >= 2
    for way in ways:
        tool = tool_position(robots.of(ARM).chain, np.array(way.q_rad))
        np.testing.assert_allclose(tool, np.add(way.point_m, (0.0, 0.0, 0.03)), atol=1e-5)
        assert way.point_m == points[way.number - 1]


def test_from_every_way_above_a_point_keys_lead_the_tip_down_to_it() -> None:
    chain, limits = robots.of(ARM).chain, np.array([joint.limits_rad for joint in ARM.joints[:5]])
    ways = holding.ways_above(ARM, holding.sheet_points(ARM, 0.03), 0.03)
    assert len({way.number for way in ways}) >= 8
    for way in ways:
        q = np.array(way.q_rad)
        for _ in range(30):  # a millimetre each
            steps = 1e-6 * np.eye(5)
            J = np.array([tool_position(chain, q + step) - tool_position(chain, q - step) for step in steps]).T / 2e-6
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(3), [0.0, 0.0, -1e-3])
            assert ((limits[:, 0] < q) & (q < limits[:, 1])).all(), way
        assert np.linalg.norm(tool_position(chain, q) - way.point_m) < 8e-3, way


def test_a_sheet_for_an_arm_that_hangs_lies_as_high_as_the_arm_comes_down(tmp_path: Path) -> None:
    """Before, it had no point: the table is 0.1 m below what this arm reaches."""
    arm = load_arm(mounted(tmp_path, "hanging"))
    points = holding.sheet_points(arm, 0.03)
    assert len(points) >= holding.FEW
    assert len({z for _, _, z in points}) == 2, "at two heights"
    assert {way.number for way in holding.ways_above(arm, points, 0.03)} == set(range(1, len(points) + 1))


def test_every_way_above_a_point_can_be_gone_from_rest() -> None:
    on, rest_rad = DrivenArm(ARM, robots.of(ARM), 0.02), [joint.rest_rad for joint in ARM.joints]
    ways = holding.ways_above(ARM, [*holding.sheet_points(ARM, 0.03), (0.12, 0.0, 0.0), (0.15, 0.0, 0.05)], 0.03)
    for way in ways:
        moved = approach_trajectory(rest_rad, (*way.q_rad, rest_rad[5]), on, "move", None)
        assert not preflight_motion(np.array(moved.positions_rad), on, start_rad=rest_rad), way


SHEET, POSTURES = 8, 3


def touched(seed: int, geometry: str) -> tuple[float, float]:
    """How far off elsewhere [mm] an arm is with half of the touches, in the file's order and as they tell most."""
    rng, simulated = np.random.default_rng(seed), put_together(ArmSpec(), geometry, "new")
    points = [tuple(point) for point in rng.uniform([0.12, -0.14, 0.0], [0.26, 0.14, 0.12], (5 * SHEET, 3)).tolist()]
    offered = holding.ways_above(ARM, points, 0.03)
    # Only where there are so many postures is there a choice.
    chosen = [number for number, times in Counter(way.number for way in offered).items() if times >= POSTURES][:SHEET]
    ways = [way for way in offered if way.number in chosen]
    arm = SimulatedArm(ARM, seed=seed, spec=simulated)
    q = np.array([(*way.q_rad, 0.0) for way in ways])
    ticks = np.array([ticks_at(ARM, row) for row in q]) + 0.3 * rng.standard_normal(q.shape)
    said = true_tool(arm, geometry, q, seed) + 0.5e-3 / math.sqrt(3.0) * rng.standard_normal((len(q), 3))
    touches = dict(zip(ways, touches_of(ticks, said), strict=True))
    elsewhere = over_a_sheet(60, rng)
    away, at = np.array([ticks_at(ARM, row) for row in elsewhere]), true_tool(arm, geometry, elsewhere, seed)
    in_order, telling = [way for way in ways if way.posture < POSTURES][: SHEET * POSTURES // 2], list[Way]()
    while len(telling) < len(in_order):
        due = holding.left(ways, telling, (), POSTURES)
        telling.append(holding.most_telling(ARM, [touches[way] for way in telling], due)[0])
    found = (holding.fit(ARM, [touches[way] for way in some]).arm for some in (in_order, telling))
    first, second = (1e3 * np.linalg.norm(tool_by(one, away) - at, axis=1).mean() for one in found)
    return float(first), float(second)


@pytest.mark.parametrize("geometry", ["typical", "poor"])
def test_half_of_the_touches_say_more_in_the_order_that_tells_most(geometry: str) -> None:
    in_order, telling = np.array([touched(seed, geometry) for seed in range(5)]).T
    assert np.median(telling) < 0.9 * np.median(in_order)
    assert (telling < in_order).sum() >= 4


def test_touches_that_tell_nothing_change_nothing() -> None:
    rng = np.random.default_rng(0)
    q = postures(ARM, 24, rng)
    ticks, points = np.array([ticks_at(ARM, row) for row in q]), tool_position(robots.of(ARM).chain, q[:, :5])
    with refused("TOO_FEW_POINTS"):
        holding.fit(ARM, touches_of(ticks[:12], points[[0, 1] * 6]))
    with refused("POOR_FIT"):
        holding.fit(ARM, touches_of(ticks, points[::-1]))
    with refused("NO_BETTER"):
        holding.fit(ARM, touches_of(ticks, points + 1e-3 * rng.standard_normal(points.shape)))


def test_an_arm_that_is_limp_or_moves_is_not_read() -> None:
    def told(torque: bool, q: float) -> list[dict[str, object]]:
        return [{"torque_enabled": torque, "position_rad": q} for _ in ARM.joints]

    assert holding.standing_ticks(ARM, [told(True, 0.0), told(True, 0.01)])[0] == pytest.approx(512.98, abs=0.01)
    with refused("LIMP"):
        holding.standing_ticks(ARM, [told(True, 0.0), told(False, 0.0)])
    with pytest.raises(RequestRefused, match="base moved by 20 ticks"):
        holding.standing_ticks(ARM, [told(True, 0.0), told(True, 0.1)])
