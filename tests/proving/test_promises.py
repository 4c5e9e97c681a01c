"""Word against bytes: what is told or answered is compared with the very readings of its tick."""

from dataclasses import dataclass

import pytest

from armctl.dynamixel import ax12a
from proving.promises import ANSWER_TICKS, NOT_LIMP, STIFF_READINGS, Promises


@dataclass
class Reading:
    torque: bool
    fresh: bool = True

    @property
    def registers(self) -> bytes:
        block = bytearray(ax12a.STATUS_SIZE)
        block[ax12a.TORQUE_ENABLE.address - ax12a.STATUS_BEGIN] = int(self.torque)
        block[ax12a.TORQUE_LIMIT.address - ax12a.STATUS_BEGIN + 1] = 3
        return bytes(block)


@dataclass
class Reply:
    request_id: int
    ok: bool
    code: str = ""


class Bench:
    """An arm of two servos and what is found of it."""

    def __init__(self) -> None:
        self.found: list[str] = []
        self.promises = Promises(("base", "elbow"), lambda now_s, rule, text: self.found.append(rule))

    def ticks(
        self,
        count: int,
        *torque: bool,
        mode: str = "off",
        fresh: bool = True,
        whole: bool = True,
        reply: Reply | None = None,
    ) -> set[str]:
        for _ in range(count):
            readings = [Reading(on, fresh) for on in torque]
            self.promises.tick(1.0, mode, False, readings, [reply] if reply else [], whole)
        return set(self.found)


@pytest.mark.parametrize(
    ("torque", "fresh", "found"), [(True, True, set()), (False, True, {"status"}), (False, False, set())]
)
def test_torque_is_told_and_a_reading_has_none(torque: bool, fresh: bool, found: set[str]) -> None:
    assert Bench().ticks(1, True, torque, mode="holding", fresh=fresh) == found


@pytest.mark.parametrize("kind", ["release", "teach"])
@pytest.mark.parametrize(
    ("readings", "whole", "found"),
    [(STIFF_READINGS, True, set()), (STIFF_READINGS + 1, True, {"limp"}), (STIFF_READINGS + 1, False, set())],
)
def test_an_arm_that_is_let_go_has_torque_in_few_readings(
    kind: str, readings: int, whole: bool, found: set[str]
) -> None:
    bench = Bench()
    bench.promises.asked(kind, 7)
    assert bench.ticks(readings, False, True, whole=whole) == found


@pytest.mark.parametrize(("code", "found"), [("ILLEGAL_TRANSITION", set()), (NOT_LIMP, {"limp"})])
def test_a_refusal_leaves_torque_and_an_answer_that_some_servo_is_stiff_does_not(code: str, found: set[str]) -> None:
    bench = Bench()
    bench.promises.asked("release", 7)
    bench.ticks(1, True, True, reply=Reply(7, False, code))
    assert bench.ticks(STIFF_READINGS, True, True) == found


@pytest.mark.parametrize("lost", [False, True])
def test_whoever_lets_the_arm_go_is_answered_in_time_by_a_program_that_is_there(lost: bool) -> None:
    bench = Bench()
    bench.promises.asked("release", 7)
    assert bench.ticks(ANSWER_TICKS - 1, False, False) == set()
    if lost:
        bench.promises.lost()
    assert bench.ticks(1, False, False) == (set() if lost else {"limp"})


def test_torque_that_is_asked_for_again_may_stay() -> None:
    bench = Bench()
    bench.promises.asked("teach", 7)
    bench.promises.asked("torque_on", 8)
    assert bench.ticks(STIFF_READINGS + 2, True, True) == set()


@pytest.mark.parametrize(
    ("seen", "found"), [((False, False), set()), ((False, True), set()), ((True, False), {"limp"})]
)
def test_a_servo_that_was_seen_limp_has_torque_by_somebody_else(seen: tuple[bool, bool], found: set[str]) -> None:
    bench = Bench()
    bench.promises.asked("release", 7)
    bench.ticks(1, True, False, reply=Reply(7, False, NOT_LIMP))
    bench.ticks(1, *seen)
    assert bench.ticks(STIFF_READINGS + 1, True, False) == found
