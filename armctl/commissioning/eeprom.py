"""The servos' EEPROM: saving, comparing, restoring, and the two registers that change where a servo is found.

Rules:

1. A servo is written only if it alone answers to its id, its torque is off and its LOCK is off. Every obstacle
   to any write of a request is found before the first write.
2. No status packet is believed: a write counts when the register has been read back. (A servo whose id, baud or
   return level changes may answer either way, or not at all.)
3. Nothing here writes RAM: no torque, no goal, no speed.
"""

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import yaml
from pydantic import Field

from armctl.commissioning.arm_file import refuse_taken, write
from armctl.commissioning.scan import scan
from armctl.commissioning.texts import refusal, said
from armctl.config import Frozen, parse_yaml, validate
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import PORT_GONE, ServoBus
from armctl.dynamixel.fitness import ServoJoint, unfit_registers
from armctl.dynamixel.identify import IDENTIFY_LATENCY_MS, answers_twice
from armctl.errors import ConfigError, PortGone, RequestRefused
from armctl.files import read_text
from armctl.messages import Write

EEPROM_REGISTERS = tuple(register for register in ax12a.REGISTERS if register.eeprom)
BY_NAME = {register.name: register for register in EEPROM_REGISTERS}
# What `write_register` and `restore` write; id and baud have functions of their own.
SETTABLE = tuple(r for r in EEPROM_REGISTERS if r.writable and r not in (ax12a.ID, ax12a.BAUD))
BAUD_UNIT = 2_000_000
# A servo hears a host whose rate differs by up to 3 %; some of that belongs to its own clock.
BAUD_TOLERANCE = 0.025
MAX_BAUD = 1_000_000


class ServoEeprom(Frozen):
    """EEPROM of one servo in register units."""

    servo_id: int = Field(ge=0, le=ax12a.ID.maximum)
    registers: dict[str, int]

    def _check(self) -> None:
        for name, value in self.registers.items():
            register = BY_NAME.get(name)
            if register is None:
                raise ValueError(f"no EEPROM register {name!r}; known: {', '.join(BY_NAME)}")
            if not register.minimum <= value <= register.maximum:
                raise ValueError(f"{name} {value} is outside {register.minimum}..{register.maximum}")
        if self.registers.get(ax12a.ID.name, self.servo_id) != self.servo_id:
            raise ValueError(f"registers.id {self.registers[ax12a.ID.name]} is not servo_id {self.servo_id}")


class Snapshot(Frozen):
    """EEPROM of the servos of one bus."""

    servos: tuple[ServoEeprom, ...] = Field(min_length=1, strict=False)

    def _check(self) -> None:
        ids = [servo.servo_id for servo in self.servos]
        if twice := [servo_id for servo_id in ids if ids.count(servo_id) > 1]:
            raise ValueError(f"servo_id {twice[0]} stands here twice")


class Difference(NamedTuple):
    """A register that is not as a snapshot has it; `found` None: the servo cannot be read."""

    servo_id: int
    register: str
    wanted: int
    found: int | None


# -------------------------------------------------------------------------------------------------------- reading


def read_eeprom(bus: ServoBus, servo_id: int) -> ServoEeprom:
    """Bytes 0..23 of one servo, by register.

    Raises:
        RequestRefused: it does not answer well.
        PortGone: the port vanished.
    """
    table = read_table(bus, servo_id, 0, ax12a.EEPROM_END)
    return ServoEeprom.model_construct(  # unchecked: what a servo holds is a fact, even out of range
        servo_id=servo_id,
        registers={register.name: ax12a.register_value(register, table, 0) for register in EEPROM_REGISTERS},
    )


def save(bus: ServoBus, servo_ids: Iterable[int], path: Path) -> Snapshot:
    """Write the EEPROM of the servos into a new file: JSON if its name ends so, else YAML.

    Raises:
        RequestRefused: a servo does not answer, or the file exists.
        ConfigError: the file cannot be written.
    """
    refuse_taken(path)
    snapshot = Snapshot.model_construct(servos=tuple(read_eeprom(bus, servo_id) for servo_id in servo_ids))
    data = snapshot.model_dump(mode="json")
    write(path, json.dumps(data, indent=1) + "\n" if path.suffix == ".json" else yaml.safe_dump(data, sort_keys=False))
    return snapshot


def load(path: Path) -> Snapshot:
    """A snapshot as `save` wrote it.

    Raises:
        ConfigError: what is wrong in it, and where.
    """
    return validate(Snapshot, parse_yaml(read_text(path, "EEPROM file"), str(path)), str(path))


def differences(bus: ServoBus, snapshot: Snapshot) -> list[Difference]:
    """Every register of the snapshot's servos that now holds something else.

    Raises:
        PortGone: the port vanished.
    """
    found: list[Difference] = []
    for servo in snapshot.servos:
        present: dict[str, int] = {}
        with suppress(RequestRefused):
            present = read_eeprom(bus, servo.servo_id).registers
        rows = [(name, wanted, present.get(name)) for name, wanted in servo.registers.items()]
        found += [Difference(servo.servo_id, *row) for row in rows if row[1] != row[2]]
    return found


# -------------------------------------------------------------------------------------------------------- writing


def write_register(bus: ServoBus, servo_id: int, register: ax12a.Register, value: int) -> None:
    """Write one EEPROM register of one servo and read it back.

    Raises:
        RequestRefused: the servo is not fit to be written (rule 1), or did not take the value.
        ConfigError: not a register for this function, or the value is out of its range.
        PortGone: the port vanished.
    """
    if register not in SETTABLE:
        names = ", ".join(known.name for known in SETTABLE)
        raise ConfigError(register.name, "", "is not set this way", f"one of {names}; id and baud have own commands")
    if not register.minimum <= value <= register.maximum:
        raise ConfigError(register.name, str(value), f"outside {register.minimum}..{register.maximum}")
    bus.port.allow_latency(IDENTIFY_LATENCY_MS)
    # A servo that answers nothing but a PING can be asked nothing, and only this write can change that.
    mute = register is ax12a.RETURN_LEVEL and bus.read(servo_id, ax12a.MODEL) is None and _answers(bus, servo_id)
    if not mute:
        require_writable(bus, servo_id)
    write_confirmed(bus, servo_id, register, value)


def restore(bus: ServoBus, snapshot: Snapshot, servo_ids: Sequence[int] = ()) -> list[Difference]:
    """Write back what differs from the snapshot, but id and baud; every write is read back.

    Args:
        servo_ids: Which servos of the snapshot; none: all.
    Returns:
        What was changed, with the value each register had.
    Raises:
        RequestRefused: a servo is not fit to be written (found before anything is written), is another model, has
            another baud than the snapshot, or did not take a value.
        ConfigError: the snapshot does not hold a servo.
        PortGone: the port vanished.
    """
    held = {servo.servo_id: servo for servo in snapshot.servos}
    chosen = tuple(servo_ids) or tuple(held)
    for servo_id in chosen:
        if servo_id not in held:
            raise ConfigError("servo", str(servo_id), "not in the file", f"it holds {', '.join(map(str, held))}")
    refusals: list[str] = []
    for servo_id in chosen:
        try:
            require_writable(bus, servo_id)
        except RequestRefused as refusal:
            refusals += refusal.reasons
            continue
        present = read_eeprom(bus, servo_id).registers
        for register in (ax12a.MODEL, ax12a.BAUD):
            wanted = held[servo_id].registers.get(register.name, present[register.name])
            if present[register.name] != wanted:
                key, told = "other model" if register is ax12a.MODEL else "other baud", {"register": register.name}
                refusals.append(said(key, servo_id=servo_id, found=present[register.name], wanted=wanted, **told))
    if refusals:
        raise RequestRefused("NOT_RESTORED", refusals)
    subset = Snapshot(servos=tuple(held[servo_id] for servo_id in chosen))
    changed = [difference for difference in differences(bus, subset) if BY_NAME[difference.register] in SETTABLE]
    for difference in changed:
        write_confirmed(bus, difference.servo_id, BY_NAME[difference.register], difference.wanted)
    return changed


def mend(bus: ServoBus, joints: Sequence[ServoJoint]) -> list[Difference]:
    """Write what forbids the joints to move (`unfit_registers`), and nothing else; every write is read back.

    Returns:
        What was changed, with the value each register had.
    Raises:
        RequestRefused: a servo is not fit to be written (found before anything is written), or did not take a value.
        PortGone: the port vanished.
    """
    for joint in joints:
        require_writable(bus, joint.servo_id)
    tables = [read_table(bus, joint.servo_id, 0, ax12a.EEPROM_END) for joint in joints]
    unfit = [(joint, it) for joint, table in zip(joints, tables, strict=True) for it in unfit_registers(joint, table)]
    for joint, it in unfit:
        write_confirmed(bus, joint.servo_id, it.register, it.value)
    return [Difference(joint.servo_id, it.register.name, it.value, it.found) for joint, it in unfit]


def set_id(bus: ServoBus, old: int, new: int) -> None:
    """Give the servo `old` the id `new`.

    Raises:
        RequestRefused: `new` is taken, two servos answer to `old`, it is not fit to be written, or did not take it.
        ConfigError: an id out of range, or both the same.
        PortGone: the port vanished.
    """
    for servo_id in (old, new):
        if not 0 <= servo_id <= ax12a.ID.maximum:
            raise ConfigError("id", str(servo_id), f"outside 0..{ax12a.ID.maximum}")
    if old == new:
        raise ConfigError("id", str(new), "old and new are the same")
    require_writable(bus, old)
    if _answers(bus, new):
        raise refusal("ID_TAKEN id", servo_id=new)
    bus.write(Write(old, ax12a.ID.address, ax12a.ID.size, new))
    if bus.read(new, ax12a.ID) != new:
        raise _not_taken(bus, f"servo {old}: it does not answer as {new}")
    if _answers(bus, old):
        raise refusal("DUPLICATE_ID still", servo_id=new, old=old)


def set_baud(bus: ServoBus, servo_id: int, baud: int) -> int:
    """Set a servo's rate and find it again; the port is then at `baud`.

    Returns:
        The rate the servo really has, within 2.5 % of `baud`.
    Raises:
        RequestRefused: the servo is not fit to be written, its id is taken at the new rate, or it is not found there.
        ConfigError: a rate no servo has.
        PortMissing: a rate the adapter cannot do.
        PortGone: the port vanished.
    """
    value = round(BAUD_UNIT / baud) - 1 if 0 < baud <= MAX_BAUD else -1
    real = BAUD_UNIT // (value + 1) if value >= 0 else 0
    if not 1 <= value <= ax12a.BAUD.maximum or abs(real / baud - 1.0) > BAUD_TOLERANCE:
        raise ConfigError("baud", str(baud), "no rate of an AX-12A", said("bauds"))
    require_writable(bus, servo_id)
    before = bus.port.baudrate
    if before != baud:
        bus.port.setBaudRate(baud)
        taken = _answers(bus, servo_id)
        bus.port.setBaudRate(before)
        if taken:
            raise refusal("ID_TAKEN baud", servo_id=servo_id, baud=baud)
    bus.write(Write(servo_id, ax12a.BAUD.address, ax12a.BAUD.size, value))
    bus.port.setBaudRate(baud)
    if bus.read(servo_id, ax12a.BAUD) == value:
        return real
    bus.port.setBaudRate(before)
    where = f"it still answers at {before}" if _answers(bus, servo_id) else "try `armctl scan --baud all`"
    raise _not_taken(bus, f"servo {servo_id}: not found at {baud} baud; {where}")


def require_writable(bus: ServoBus, servo_id: int) -> None:
    """Rule 1 for one servo; the port's patience becomes that of a slow adapter.

    Raises:
        RequestRefused: why it must not be written.
        PortGone: the port vanished.
    """
    bus.port.allow_latency(IDENTIFY_LATENCY_MS)
    if answers_twice(bus, servo_id):
        raise refusal("DUPLICATE_ID asked", servo_id=servo_id)
    status = read_table(bus, servo_id, ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE)
    if ax12a.register_value(ax12a.TORQUE_ENABLE, status):
        raise refusal("TORQUE_ON eeprom", servo_id=servo_id)
    if ax12a.register_value(ax12a.LOCK, status):
        raise refusal("LOCKED", servo_id=servo_id)


def write_confirmed(bus: ServoBus, servo_id: int, register: ax12a.Register, value: int) -> None:
    """Write a register and read it back; nothing is asked before.

    Raises:
        RequestRefused: it did not take the value.
        PortGone: the port vanished.
    """
    bus.write(Write(servo_id, register.address, register.size, value))
    if (found := bus.read(servo_id, register)) != value:
        raise _not_taken(bus, f"servo {servo_id}: {register.name} was to be {value} and reads {found}")


def _not_taken(bus: ServoBus, text: str) -> RequestRefused | PortGone:
    if not bus.is_open:
        return PortGone(f"{bus.port.port_name}: the port vanished; {text}")
    return RequestRefused("NOT_WRITTEN", text)


def _answers(bus: ServoBus, servo_id: int) -> bool:
    """Whether anything at all comes from an id, be it garbled or nothing but a PING's status."""
    return bool(scan(bus, (bus.port.baudrate,), (servo_id,)))


def read_table(bus: ServoBus, servo_id: int, begin: int, size: int) -> bytes:
    """Bytes of a servo's control table.

    Raises:
        RequestRefused: it does not answer well.
        PortGone: the port vanished.
    """
    bus.port.allow_latency(IDENTIFY_LATENCY_MS)
    reply = bus.read_block(servo_id, begin, size)
    if reply.problem == PORT_GONE:
        raise PortGone(f"{bus.port.port_name}: the port vanished; plug the adapter in again")
    if reply.problem:
        raise refusal("SERVO_SILENT table", servo_id=servo_id, baud=bus.port.baudrate, problem=reply.problem)
    return reply.data
