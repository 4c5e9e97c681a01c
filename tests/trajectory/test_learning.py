"""What motions teach of an arm's lag, by arms whose lag is made from a model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.messages import LagModel
from armctl.trajectory.lag import nominal, predict, regressors
from armctl.trajectory.learning import (
    FEWEST,
    KEPT,
    SAMPLES,
    Experience,
    Lesson,
    Seen,
    learn,
    sums_of,
)
from tests.genetic import hand

ARM, CHAIN = hand.arm(), hand.robot().chain
PERIOD_S = 0.1
NOMINAL = nominal(ARM, CHAIN)
TICKS = 61


def an_arm(rng: np.random.Generator, spread: float = 0.3) -> LagModel:
    rows = [[g * rng.uniform(1.0 - spread, 1.0 + spread) for g in row] for row in NOMINAL.rows]
    return replace(NOMINAL, rows=tuple(map(tuple, rows)))


def a_motion(truth: LagModel, rng: np.random.Generator, noise_tick: float = 0.3) -> Seen:
    """A motion of that arm from here to there, goals sent as the nominal model has them."""
    limits = np.array([joint.limits_rad for joint in ARM.joints])[:5]
    ends = rng.uniform(0.5 * limits[:, 0], 0.5 * limits[:, 1], (2, 5))
    way = (0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, TICKS)))[:, None]
    wanted = ends[0] + way * (ends[1] - ends[0]) * 0.4
    due_s: np.ndarray = (1.0 + np.arange(TICKS)) * PERIOD_S
    lags = predict(truth, regressors(CHAIN, wanted, np.zeros(5), PERIOD_S))
    goals = wanted + predict(NOMINAL, regressors(CHAIN, wanted, np.zeros(5), PERIOD_S))
    read_s = np.tile(due_s[:, None], (1, 5))
    noise = noise_tick * TICK_RAD * rng.standard_normal(wanted.shape)
    return Seen(due_s, goals, wanted, read_s, goals - lags + noise, np.ones(wanted.shape, dtype=bool))


def taught(truth: LagModel, rng: np.random.Generator, count: int, begun: Lesson | None = None) -> list[Lesson]:
    """What so many motions teach, one after the other."""
    lessons = [begun or Lesson(Experience(), NOMINAL)]
    for _ in range(count):
        present = next(lesson.model for lesson in reversed(lessons) if lesson.model is not None)
        sums = sums_of(CHAIN, a_motion(truth, rng), PERIOD_S)
        lessons.append(learn(ARM, CHAIN, lessons[-1].experience, present, sums))
    return lessons[1:]


def in_use(lessons: list[Lesson]) -> LagModel:
    return next(lesson.model for lesson in reversed(lessons) if lesson.model is not None)


def unforeseen_tick(model: LagModel, truth: LagModel, rng: np.random.Generator) -> float:
    """What a model leaves of motions that nobody has learnt from, in ticks."""
    left = []
    for _ in range(8):
        q = a_motion(truth, rng).wanted_rad
        X = regressors(CHAIN, q, np.zeros(5), PERIOD_S)
        left.append(predict(model, X) - predict(truth, X))
    return float(np.sqrt(np.mean(np.square(left)))) / TICK_RAD


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_what_is_used_predicts_new_motions_better_than_what_was_used_before(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = an_arm(rng)
    lessons = taught(truth, rng, 12)
    assert all(lesson.model is None for lesson in lessons[: FEWEST - 1])
    assert unforeseen_tick(in_use(lessons), truth, rng) < 0.5 * unforeseen_tick(NOMINAL, truth, rng)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_an_arm_that_is_as_its_model_says_is_not_told_of_and_hardly_learnt_anew(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lessons = taught(an_arm(rng), rng, 20)
    assert not any(lesson.change for lesson in lessons)
    truth = replace(NOMINAL, residual_tick=(0.3,) * 5, lines=8)
    later = taught(truth, rng, 12, Lesson(Experience(), truth))
    models = [lesson.model for lesson in later if lesson.model is not None]
    assert all(unforeseen_tick(model, truth, rng) < 0.2 for model in models)


def test_the_same_motions_teach_the_same_model() -> None:
    found = [in_use(taught(an_arm(np.random.default_rng(1)), np.random.default_rng(2), 9)) for _ in range(2)]
    assert found[0] == found[1]


def test_no_more_motions_are_kept_than_a_model_needs() -> None:
    lessons = taught(an_arm(np.random.default_rng(1)), np.random.default_rng(2), KEPT + 3)
    assert len(lessons[-1].experience.motions) == KEPT


@pytest.mark.parametrize(("first", "last", "times", "joint"), [(0, 5, 2.0, "shoulder"), (5, 6, 2.2, "elbow")])
def test_a_change_is_told_forgets_the_past_and_is_learnt(first: int, last: int, times: float, joint: str) -> None:
    """Another weight, another friction; one strange motion alone makes nothing forgotten."""
    rng = np.random.default_rng(3)
    truth = an_arm(rng, 0.2)
    before = taught(truth, rng, 12)
    rows = [[g * (times if first <= k < last else 1.0) for k, g in enumerate(row)] for row in truth.rows]
    other = replace(truth, rows=tuple(map(tuple, rows)))
    after = taught(other, rng, FEWEST + 1, Lesson(before[-1].experience, in_use(before)))
    assert joint in after[0].change
    assert "calibrate --sag" in after[0].change
    kept = [len(lesson.experience.motions) for lesson in after]
    assert kept == [13, *range(2, FEWEST + 2)]
    assert after[FEWEST - 1].model is not None
    assert after[-1].change == ""
    assert unforeseen_tick(in_use(after), other, rng) < 0.6


def test_one_strange_motion_leaves_nothing_behind() -> None:
    rng = np.random.default_rng(4)
    truth = an_arm(rng, 0.2)
    before = taught(truth, rng, 12)
    known, present = before[-1].experience, in_use(before)
    pushed = replace(truth, rows=tuple(tuple(3.0 * g for g in row) for row in truth.rows))
    odd, ordinary = (sums_of(CHAIN, a_motion(arm, rng), PERIOD_S) for arm in (pushed, truth))
    strange = learn(ARM, CHAIN, known, present, odd)
    assert strange.change
    assert strange.model is None
    after, without = (learn(ARM, CHAIN, begun, present, ordinary) for begun in (strange.experience, known))
    assert (after.change, after.model) == ("", without.model)
    assert after.experience.motions == without.experience.motions


def test_a_joint_whose_friction_may_push_either_way_tells_nothing() -> None:
    rng = np.random.default_rng(6)
    seen = a_motion(an_arm(rng), rng)
    still = seen.wanted_rad.copy()
    still[:, 0] = still[0, 0]
    seen = seen._replace(wanted_rad=still)
    sums = sums_of(CHAIN, seen, PERIOD_S)
    assert sums.count[0] == 0
    assert (sums.count[1:] > SAMPLES).all()


def test_goals_at_rest_teach_nothing() -> None:
    rng = np.random.default_rng(6)
    seen = a_motion(an_arm(rng), rng)
    more = 10
    longer = {
        name: np.concatenate([values, np.repeat(values[-1:], more, axis=0)]) for name, values in seen._asdict().items()
    }
    longer["due_s"] = (1.0 + np.arange(TICKS + more)) * PERIOD_S
    longer["read_s"] = np.tile(longer["due_s"][:, None], (1, 5))
    longer["goals_rad"][-3:, 2] += TICK_RAD
    np.testing.assert_array_equal(sums_of(CHAIN, Seen(**longer), PERIOD_S).count, sums_of(CHAIN, seen, PERIOD_S).count)


def test_a_servo_that_did_not_answer_tells_nothing() -> None:
    rng = np.random.default_rng(7)
    seen = a_motion(an_arm(rng), rng)
    unheard = seen.fresh.copy()
    unheard[:, 3] = False
    sums = sums_of(CHAIN, seen._replace(fresh=unheard), PERIOD_S)
    assert sums.count[3] == 0
    assert sums.count[2] > SAMPLES
