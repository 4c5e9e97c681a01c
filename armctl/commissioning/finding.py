"""Every servo of an arm, each with an id of its own and at the daemon's baud; with the person beside it.

What is in the way is one sentence. Who asks tries again once the person has mended it.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from armctl.commissioning import eeprom
from armctl.commissioning.scan import USUAL_BAUDS, FoundServo, scan
from armctl.commissioning.texts import refusal, said
from armctl.config import Frozen, parse_yaml
from armctl.dynamixel import ax12a, servos
from armctl.dynamixel.bus import ServoBus
from armctl.errors import ConfigError, RequestRefused
from armctl.files import read_text

YES = ("yes", "no")
# The bus to these servos, open, closed afterwards.
Opened = Callable[[Sequence[int]], AbstractContextManager[ServoBus]]


class Person(Protocol):
    """Who stands beside the arm."""

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        """Have something done, or answered by one of the choices; the key names the question in prepared answers."""
        ...

    def again(self, defect: RequestRefused) -> bool:
        """Tell what is wrong; whether to try again."""
        ...


class Prepared:
    """Answers from a file (YAML), by the key of the question. Where only Enter is wanted, none need stand there."""

    def __init__(self, file: Path) -> None:
        """
        Raises:
            ConfigError: the file cannot be read.
        """
        self._file, self.answers = str(file), parse_yaml(read_text(file, "answers"), str(file))

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        """
        Raises:
            ConfigError: no choice stands in the file.
        """
        found = str(self.answers.get(key, ""))
        if choices and found not in choices:
            raise ConfigError(self._file, key, f"{found!r} does not answer {text!r}", f"one of: {', '.join(choices)}")
        return found

    def again(self, defect: RequestRefused) -> bool:
        return False


class Servo(Frozen):
    """One that answers."""

    servo_id: int
    model: str


def every_servo(opened: Opened, person: Person, needed: int) -> tuple[Servo, ...]:
    """The servos of an arm that needs so many; ids that are shared and other bauds are mended on the way.

    Raises:
        RequestRefused: one is missing, shares its id, has another baud, or is none that armctl drives.
        BusError: the port cannot be used.
    """
    bent = False
    while True:
        with opened(()) as bus:
            home = bus.port.baudrate
            found = scan(bus, (home,))
            if len(found) < needed:
                found += scan(bus, [baud for baud in USUAL_BAUDS if baud != home])
        if clash := next((one for one in found if one.clash), None):
            _part(opened, person, clash, found)
        elif stray := next((one for one in found if one.baud != home), None):
            _bring_home(opened, person, stray, found, home)
        elif len(found) >= needed:
            return tuple(map(_driven, found))
        elif not bent:  # two of one id that read the same look like one
            person.ask("bend", said("bend"))
            bent = True
        else:
            break
    ids = ", ".join(str(one.servo_id) for one in found) or "none"
    raise refusal("SERVO_MISSING", found=len(found), needed=needed, ids=ids)


def _part(opened: Opened, person: Person, clash: FoundServo, found: Sequence[FoundServo]) -> None:
    """Give one of several servos with one id another."""
    old, new = clash.servo_id, _free(found)
    person.ask(f"alone.{old}", f"several servos have the id {old}: unplug all of these but one")
    with opened(()) as bus:
        bus.port.setBaudRate(clash.baud)
        eeprom.set_id(bus, old, new)
    person.ask(f"back.{old}", f"that one has the id {new} now: plug the others in again")


def _bring_home(opened: Opened, person: Person, stray: FoundServo, found: Sequence[FoundServo], home: int) -> None:
    """Set a servo to the daemon's baud."""
    servo_id = stray.servo_id
    person.ask(f"baud.{servo_id}", f"servo {servo_id} answers at {stray.baud} baud, and is set to {home} now")
    with opened(()) as bus:
        bus.port.setBaudRate(stray.baud)
        if any(one.servo_id == servo_id and one is not stray for one in found):
            eeprom.set_id(bus, servo_id, new := _free(found))
            servo_id = new
        eeprom.set_baud(bus, servo_id, home)


def _free(found: Sequence[FoundServo]) -> int:
    return min(set(range(1, ax12a.ID.maximum)).difference(one.servo_id for one in found))


def _driven(one: FoundServo) -> Servo:
    """A servo that armctl drives.

    Raises:
        RequestRefused: it is none, or cannot be read.
    """
    model = None if one.model is None else servos.by_number(one.model)
    if model is not None:
        return Servo(servo_id=one.servo_id, model=model.name)
    key = "WRONG_MODEL mute" if one.model is None else "WRONG_MODEL other"
    raise refusal(key, servo_id=one.servo_id, model=one.model)
