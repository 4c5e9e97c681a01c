"""Every servo of a simulated arm is found, or what is in the way is said; a person does what is asked."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from armctl.commissioning.finding import Prepared, every_servo
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.errors import ConfigError
from armctl.sim.faults import Fault
from tests.commissioning.bench import Bench
from tests.host.doubles import refused


class Stand:
    """A bench whose person notes what is asked, and unplugs what shares the id 3 when told to."""

    def __init__(self) -> None:
        self.bench = Bench()
        self.bench.bus.close()
        self.asked: list[str] = []
        self._unplugged: list[int] = []

    @contextmanager
    def opened(self, servo_ids: Sequence[int]) -> Iterator[ServoBus]:
        self.bench.port.setBaudRate(1_000_000)
        bus = ServoBus(self.bench.port, servo_ids)
        bus.open()
        with closing(bus):
            yield bus

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        self.asked.append(key)
        arm = self.bench.arm
        if key == "alone.3":
            self._unplugged.append(arm.faults.begin(Fault(kind="mute", servo_id=5), arm.time_s))
        elif key == "back.3":
            arm.faults.end(self._unplugged.pop())
        return ""

    def again(self, refusal: object) -> bool:
        return False

    def ids(self, needed: int = 6) -> list[int]:
        return [servo.servo_id for servo in every_servo(self.opened, self, needed)]


@pytest.fixture
def stand() -> Stand:
    return Stand()


def test_servos_that_answer_need_nobody(stand: Stand) -> None:
    assert stand.ids() == [1, 2, 3, 4, 5, 6]
    assert stand.asked == []


def test_one_of_two_with_an_id_gets_another_once_it_is_alone(stand: Stand) -> None:
    stand.bench.servos[4].set(ax12a.ID, 3)
    assert sorted(stand.ids()) == [1, 2, 3, 4, 5, 6]
    assert stand.asked == ["alone.3", "back.3"]
    assert stand.bench.servos[2].get(ax12a.ID) == 5


def test_another_baud_is_set_and_an_id_that_is_taken_there_changed_first(stand: Stand) -> None:
    stand.bench.servos[3].set(ax12a.BAUD, 34)
    stand.bench.servos[3].set(ax12a.ID, 3)
    assert sorted(stand.ids()) == [1, 2, 3, 4, 5, 6]
    assert stand.asked == ["baud.3"]
    assert stand.bench.servos[3].baud == 1_000_000


def test_a_missing_one_a_stranger_and_one_that_reads_nothing_are_told(stand: Stand) -> None:
    with refused("SERVO_MISSING", r"6 of 7 servos answer \(1, 2, 3, 4, 5, 6\); check the supply"):
        stand.ids(7)
    stand.bench.servos[1].set(ax12a.MODEL, 29)
    with refused("WRONG_MODEL", "servo 2 is model 29, which armctl does not drive"):
        stand.ids()
    stand.bench.servos[0].set(ax12a.RETURN_LEVEL, 0)
    with refused("WRONG_MODEL", "armctl servo set 1 status_return_level 2"):
        stand.ids()


def test_prepared_answers_are_those_of_the_file_and_a_missing_one_names_its_key(tmp_path: Path) -> None:
    file = tmp_path / "answers.yaml"
    file.write_text("base.went: no\nname: 7\n")
    person = Prepared(file)
    assert (person.ask("base.went", "?", ("yes", "no")), person.ask("name", "?"), person.ask("rest", "?")) == (
        "no", "7", "",
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"answers.yaml: motion: '' does not answer 'free\?'; one of: yes, no"):
        person.ask("motion", "free?", ("yes", "no"))
