"""`armctl servo`: ids, bauds and the rest of the EEPROM. None of its commands moves a servo."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armctl.cli.output import ARM, BAUD, CONFIG, PORT, Output, command
from armctl.cli.setup import opened
from armctl.cli.tables import show_rows

if TYPE_CHECKING:
    from armctl.commissioning.eeprom import Difference

WIRING = (PORT, BAUD, CONFIG)


@click.group("servo")
def servo_command() -> None:
    """Write the EEPROM of servos: torque is off, one servo has each id, every write is read back.

    Example: armctl servo set-id 1 4
    """


@command("set-id", *WIRING, group=servo_command)
def set_id_command(output: Output, old: int, new: int) -> None:
    """Give the servo OLD the id NEW; refused when NEW is taken or two servos answer to OLD.

    Example: armctl servo set-id 1 4
    """
    from armctl.commissioning.eeprom import set_id

    with opened(output) as bus:
        set_id(bus, old, new)
    output.answer({"id": new, "before": old}, f"servo {old} is now servo {new}")


@command("set-baud", *WIRING, group=servo_command)
def set_baud_command(output: Output, servo: int, rate: int) -> None:
    """Set the servo to RATE bit/s and find it again there; --baud is what it has now.

    Example: armctl servo set-baud 1 1000000 --baud 57600
    """
    from armctl.commissioning.eeprom import set_baud

    with opened(output) as bus:
        before = bus.port.baudrate
        real = set_baud(bus, servo, rate)
    said, usual = f"servo {servo} answers at {rate} baud", output.config.baud
    if rate != usual:
        said += f"\nThe daemon talks at {usual}; set `baud` in its configuration once all servos have {rate}."
    output.answer({"id": servo, "baud": rate, "real_baud": real, "before": before}, said)


@command("set-return-delay", ARM, *WIRING, group=servo_command)
def set_return_delay_command(output: Output, servo: str, delay_us: int) -> None:
    """How long the servo waits before it replies, in steps of 2 us; `all`: every servo of the arm.

    Example: armctl servo set-return-delay all 0
    """
    from armctl.commissioning.eeprom import require_writable, write_register
    from armctl.dynamixel import ax12a

    servo_ids = _servo_ids(output, servo)
    steps = delay_us // 2
    with opened(output) as bus:
        for servo_id in servo_ids:
            require_writable(bus, servo_id)
        for servo_id in servo_ids:
            write_register(bus, servo_id, ax12a.RETURN_DELAY, steps)
    output.answer({"ids": list(servo_ids), "return_delay_us": steps * 2}, who=", ".join(map(str, servo_ids)))


def _servo_ids(output: Output, servo: str) -> tuple[int, ...]:
    if servo != "all" and not servo.isdecimal():
        raise click.BadParameter(f"{servo!r} is neither an id nor `all`", param_hint="ID")
    return output.arm.servo_ids if servo == "all" else (int(servo),)


@command("mend", ARM, *WIRING, group=servo_command)
def mend_command(output: Output, servo: str) -> None:
    """Write what the daemon needs before it switches torque on: angle limits of the arm's file, and protection.

    Nothing else is written, and nothing unless every servo can be.

    Example: armctl servo mend all
    """
    from armctl.commissioning.eeprom import mend

    servo_ids, arm = _servo_ids(output, servo), output.arm
    if strangers := [servo_id for servo_id in servo_ids if servo_id not in arm.servo_ids]:
        raise click.BadParameter(f"servo {strangers[0]} is not of the arm {arm.arm_id}", param_hint="ID")
    with opened(output) as bus:
        changed = mend(bus, [one for one in arm.servos if one.servo_id in servo_ids])
    shown = partial(show_differences, output, changed, "mended")
    output.answer({"mended": [it._asdict() for it in changed]}, shown if changed else "nothing to mend")


@command("set", *WIRING, group=servo_command)
def set_command(output: Output, servo: int, register: str, value: int) -> None:
    """Write one EEPROM register, by its name in the control table, in its own unit.

    Example: armctl servo set 3 ccw_angle_limit 1006
    """
    from armctl.commissioning.eeprom import SETTABLE, write_register

    known = {known.name: known for known in SETTABLE}
    if register not in known:
        raise click.BadParameter(f"{register!r}; one of: {', '.join(known)}", param_hint="REGISTER")
    with opened(output) as bus:
        write_register(bus, servo, known[register], value)
    output.answer({"id": servo, "register": register, "value": value}, f"servo {servo}: {register} is {value}")


@servo_command.group("eeprom")
def eeprom_command() -> None:
    """Save, compare and restore the EEPROM of all servos.

    Example: armctl servo eeprom save before.yaml
    """


@command("save", ARM, *WIRING, group=eeprom_command)
def eeprom_save(output: Output, file: Path) -> None:
    """Write the EEPROM of every servo of the arm into FILE (YAML, or JSON by its name); never overwrites.

    Example: armctl servo eeprom save before.yaml
    """
    from armctl.commissioning.eeprom import save

    servo_ids = output.arm.servo_ids
    with opened(output) as bus:
        servos = save(bus, servo_ids, file).servos
    output.answer({"path": str(file), "servos": [servo.model_dump() for servo in servos]}, count=len(servos))


@command("diff", *WIRING, group=eeprom_command)
def eeprom_diff(output: Output, file: Path) -> int:
    """Show where the servos differ from FILE; exit status 1 if they do.

    Example: armctl servo eeprom diff before.yaml
    """
    from armctl.commissioning.eeprom import differences, load

    snapshot = load(file)
    with opened(output) as bus:
        found = differences(bus, snapshot)
    shown = partial(show_differences, output, found, "differ")
    output.answer({"differences": [difference._asdict() for difference in found]}, shown if found else "no difference")
    return 1 if found else 0


@command("restore", *WIRING, group=eeprom_command)
def eeprom_restore(output: Output, file: Path, servos: tuple[int, ...]) -> None:
    """Write back what differs from FILE, except id and baud; nothing is written unless every servo can be.

    Example: armctl servo eeprom restore before.yaml --servo 3
    """
    from armctl.commissioning.eeprom import load, restore

    snapshot = load(file)
    with opened(output) as bus:
        changed = restore(bus, snapshot, servos)
    if not output.result({"restored": [difference._asdict() for difference in changed]}):
        show_differences(output, changed, "mended")
        output.say(f"{len(changed)} registers restored")


def show_differences(output: Output, found: Sequence[Difference], table: str) -> None:
    if found:
        show_rows(output.console, table, "", [it._asdict() for it in found])
