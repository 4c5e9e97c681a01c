import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from armctl.errors import RequestRefused
from armctl.genetic.alignment import Candidates, align
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.straightness import progress_along_line
from tests.genetic import hand

ARM, CHAIN = hand.arm(), hand.robot().chain


def aligned(recordings: list[FloatArray], A: FloatArray = hand.A, B: FloatArray = hand.B, m: int = 50) -> Candidates:
    return align(recordings, ARM, CHAIN, A, B, m)


def straight(samples: int = 65) -> FloatArray:
    line = hand.joint_line()
    shares = np.linspace(0.0, 64.0, samples)
    return np.column_stack([*(np.interp(shares, range(65), joint) for joint in line.T), np.full(samples, 0.3)])


def test_every_candidate_begins_exactly_on_A_and_ends_exactly_on_B() -> None:
    candidates = aligned(hand.recordings(4, 1))
    assert candidates.positions_rad.shape == (4, 50, 6)
    for row in candidates.tool_m:
        np.testing.assert_allclose(row[[0, -1]], [hand.A, hand.B], atol=1e-8)


def test_stations_lie_at_equal_progress_and_never_go_back() -> None:
    candidates = aligned(hand.recordings(6, 2))
    progress = progress_along_line(candidates.tool_m, hand.A, hand.B)
    np.testing.assert_allclose(progress, np.broadcast_to(candidates.progress, progress.shape), atol=2e-3)
    np.testing.assert_allclose(np.diff(candidates.progress), 1.0 / 49.0)


def test_joint_positions_stay_within_the_limits_of_the_arm() -> None:
    recordings = hand.recordings(3, 3)
    for samples in recordings:
        samples[:, 5] = 3.0
    candidates = aligned(recordings)
    for i, joint in enumerate(ARM.joints):
        low, high = joint.limits_rad
        assert low <= candidates.positions_rad[..., i].min() <= candidates.positions_rad[..., i].max() <= high


def hesitant(samples: FloatArray) -> FloatArray:
    """The same way with dead time, a stop, and some of it back and again."""
    stops = np.concatenate([np.repeat(samples[:1], 30, axis=0), samples[:30], np.repeat(samples[29:30], 25, axis=0)])
    return np.concatenate([stops, samples[29:20:-1], samples[20:], np.repeat(samples[-1:], 9, axis=0)])


def led_to_A(samples: FloatArray) -> FloatArray:
    """The same way, and before it the way to A, along the line."""
    return np.concatenate([samples[::-2], samples])


@pytest.mark.parametrize("taken", [hesitant, led_to_A])
def test_dead_time_stops_going_back_and_the_way_to_A_do_not_matter(taken: Callable[[FloatArray], FloatArray]) -> None:
    plain, same = aligned([straight(), taken(straight())]).positions_rad
    np.testing.assert_allclose(same, plain, atol=1e-9)


def test_what_lies_before_A_and_beyond_B_is_left_out() -> None:
    samples = straight(129)
    start, end = hand.A + (hand.B - hand.A) * np.array([[0.2], [0.8]])
    inner = aligned([samples], start, end)
    assert inner.tool_m[0, 0] == pytest.approx(start, abs=1e-8)
    assert np.linalg.norm(inner.tool_m[0] - np.linspace(start, end, 50), axis=1).max() < 1e-3


@pytest.mark.parametrize("height_m", [0.0, 0.009])
def test_a_line_without_length_is_refused(height_m: float) -> None:
    with pytest.raises(RequestRefused, match=r"A and B are \d\.0 mm apart, at least 10 mm"):
        aligned([straight()], hand.B + np.array([0.0, 0.0, height_m]), hand.B)


def test_nothing_or_too_much_to_align_is_refused() -> None:
    for recordings in ([], [straight()] * 41):
        with pytest.raises(RequestRefused, match=f"{len(recordings)} recordings given; give 1 to 40"):
            aligned(recordings)


@pytest.mark.parametrize(
    ("samples", "match"),
    [
        (straight()[:, :5], r"shape \(65, 5\) is not .* the arm's 6 joints"),
        (straight()[:1], r"shape \(1, 6\)"),
        (np.zeros(6), r"shape \(6,\)"),
        (np.where(np.arange(65)[:, None] == 7, math.nan, straight()), "all finite"),
        (straight()[:40], "comes no nearer to B than 9[0-9] mm, at most 40 mm"),
        (straight()[30:], "comes no nearer to A than 1[0-9][0-9] mm, at most 40 mm"),
        (straight()[30:], r"it leads along, from 0\.180,-0\.008,0\.100 to 0\.180,0\.125,0\.100"),
        (straight()[::-1], "comes no nearer to"),
        (np.tile(straight()[32], (9, 1)), "comes no nearer to"),
        (straight() + np.array([0, 0.5, 0, 0, 0, 0]), "comes no nearer to A"),
    ],
)
def test_a_recording_that_does_not_lead_from_A_to_B_is_refused(samples: FloatArray, match: str) -> None:
    with pytest.raises(RequestRefused, match=match):
        aligned([samples])


def test_every_unfit_recording_is_named() -> None:
    with pytest.raises(RequestRefused) as caught:
        aligned([straight()[:40], straight(), straight()[:, :3]])
    assert [reason.split(":")[0] for reason in caught.value.reasons] == ["recording 1", "recording 3"]
    assert caught.value.code == "BAD_RECORDINGS"


def test_a_short_line_asks_for_a_nearer_recording() -> None:
    with pytest.raises(RequestRefused, match="at most 10 mm"):
        aligned([straight()[8:]], hand.A, hand.A + (hand.B - hand.A) * 0.16)


def test_an_end_out_of_reach_is_refused() -> None:
    far = hand.A + np.array([0.0, -0.4, 0.0])
    with pytest.raises(RequestRefused, match="recording 1: ") as caught:
        aligned([straight()], far, hand.B)
    told = r"A 0.180,-0.525,0.100 is (\d+) mm out of reach; the nearest .* is (.*)$"
    ((away_mm, place),) = re.findall(told, caught.value.reasons[0])
    nearest = np.array(place.split(","), dtype=np.float64)
    assert np.linalg.norm(nearest - far) * 1e3 == pytest.approx(float(away_mm), abs=1.0)
    assert np.linalg.norm(nearest - [0.0, 0.0, 0.1]) == pytest.approx(0.38, abs=2e-3)  # the stretched arm


def test_an_end_that_the_posture_cannot_reach_is_refused() -> None:
    # Stretched out at 0.37 m; the end lies 3 cm further, beyond the arm's reach of 0.38 m.
    turn = np.linspace(-0.6, 0.6, 40)
    samples = np.column_stack([turn, np.broadcast_to([0.2, -0.25, 0.05, 0.05, 0.0], (40, 5))])
    A, B = tool_position(CHAIN, samples[[0, -1], :5])
    out = B + (B - [0.0, 0.0, 0.1]) * 0.07
    with pytest.raises(RequestRefused, match=r"recording 1: target .* within the joint limits"):
        aligned([samples], A, out)
