"""`armctl servo`: ids, bauds and the rest of the EEPROM. None of its commands moves a servo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armctl.cli.output import Output, exit_failed, output_option
from armctl.cli.setup import FILE, arm_option, make_bus, opened, port_options
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.commissioning.eeprom import Difference

SERVO = click.IntRange(0, 253)


@click.group("servo")
def servo_command() -> None:
    """Write the EEPROM of servos: torque off, one answer an id, every write read back.

    Example: armctl servo set-id 1 4
    """


@servo_command.command("set-id")
@click.argument("old", type=SERVO)
@click.argument("new", type=SERVO)
@port_options
@output_option
def set_id_command(
    output: Output, old: int, new: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Give the servo OLD the id NEW; refused when NEW is taken or two servos answer to OLD.

    Example: armctl servo set-id 1 4
    """
    from armctl.commissioning.eeprom import set_id
    from armctl.files import load_config

    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        set_id(bus, old, new)
    if not output.result({"id": new, "before": old}):
        output.say(f"servo {old} is now servo {new}")


@servo_command.command("set-baud")
@click.argument("servo", type=SERVO)
@click.argument("rate", type=int)
@port_options
@output_option
def set_baud_command(
    output: Output, servo: int, rate: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Set the servo to RATE bit/s and find it again there; --baud is what it has now.

    Example: armctl servo set-baud 1 1000000 --baud 57600
    """
    from armctl.commissioning.eeprom import set_baud
    from armctl.files import load_config

    config = load_config(config_file)
    with opened(make_bus(config, port, baud)) as bus:
        before = bus.port.baudrate
        real = set_baud(bus, servo, rate)
    if not output.result({"id": servo, "baud": rate, "real_baud": real, "before": before}):
        output.say(f"servo {servo} answers at {rate} baud")
        if rate != config.baud:
            output.say(
                f"The daemon talks at {config.baud}; set `baud` in its configuration once all servos have {rate}."
            )


@servo_command.command("set-return-delay")
@click.argument("servo", metavar="ID|all")
@click.argument("delay_us", metavar="US", type=click.IntRange(0, 508))
@arm_option
@port_options
@output_option
def set_return_delay_command(
    output: Output,
    servo: str,
    delay_us: int,
    arm: str | None,
    port: str | None,
    baud: int | None,
    config_file: str | None,
) -> None:
    """How long the servo waits before it replies, in steps of 2 us; `all`: every servo of the arm.

    Example: armctl servo set-return-delay all 0
    """
    from armctl.commissioning.eeprom import require_writable, write_register
    from armctl.dynamixel import ax12a
    from armctl.files import load_arm, load_config

    config = load_config(config_file)
    if servo != "all" and not servo.isdecimal():
        raise click.BadParameter(f"{servo!r} is neither an id nor `all`", param_hint="ID")
    servo_ids = load_arm(arm or config.arm).servo_ids if servo == "all" else (int(servo),)
    with opened(make_bus(config, port, baud)) as bus:
        for servo_id in servo_ids:
            require_writable(bus, servo_id)
        for servo_id in servo_ids:
            write_register(bus, servo_id, ax12a.RETURN_DELAY, delay_us // 2)
    if not output.result({"ids": list(servo_ids), "return_delay_us": delay_us // 2 * 2}):
        output.say(f"servo {', '.join(map(str, servo_ids))}: return delay {delay_us // 2 * 2} us")


@servo_command.command("set")
@click.argument("servo", type=SERVO)
@click.argument("register")
@click.argument("value", type=int)
@port_options
@output_option
def set_command(
    output: Output, servo: int, register: str, value: int, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write one EEPROM register, by its name in the control table, in its own unit.

    Example: armctl servo set 3 ccw_angle_limit 1006
    """
    from armctl.commissioning.eeprom import SETTABLE, write_register
    from armctl.files import load_config

    known = {known.name: known for known in SETTABLE}
    if register not in known:
        raise click.BadParameter(f"{register!r}; one of: {', '.join(known)}", param_hint="REGISTER")
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        write_register(bus, servo, known[register], value)
    if not output.result({"id": servo, "register": register, "value": value}):
        output.say(f"servo {servo}: {register} is {value}")


@servo_command.group("eeprom")
def eeprom_command() -> None:
    """Save, compare and restore the EEPROM of all servos.

    Example: armctl servo eeprom save before.yaml
    """


@eeprom_command.command("save")
@click.argument("file", type=FILE)
@arm_option
@port_options
@output_option
def eeprom_save(
    output: Output, file: Path, arm: str | None, port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write the EEPROM of every servo of the arm into FILE (YAML, or JSON by its name); never overwrites.

    Example: armctl servo eeprom save before.yaml
    """
    from armctl.commissioning.eeprom import save
    from armctl.files import load_arm, load_config

    config = load_config(config_file)
    with opened(make_bus(config, port, baud)) as bus:
        snapshot = save(bus, load_arm(arm or config.arm).servo_ids, file)
    if not output.result({"path": str(file), "servos": [servo.model_dump() for servo in snapshot.servos]}):
        output.say(f"EEPROM of {len(snapshot.servos)} servos in {file}")


@eeprom_command.command("diff")
@click.argument("file", type=FILE)
@port_options
@output_option
def eeprom_diff(output: Output, file: Path, port: str | None, baud: int | None, config_file: str | None) -> int:
    """What the servos hold otherwise than FILE; exit status 1 when something differs.

    Example: armctl servo eeprom diff before.yaml
    """
    from armctl.commissioning.eeprom import differences, load
    from armctl.files import load_config

    snapshot = load(file)
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        found = differences(bus, snapshot)
    if not output.result({"differences": [asdict(difference) for difference in found]}):
        show_differences(output, found, "file", "servo")
        if not found:
            output.say("no difference")
    return exit_failed() if found else 0


@eeprom_command.command("restore")
@click.argument("file", type=FILE)
@click.option("--servo", "servos", type=SERVO, multiple=True, help="Only this servo; may be given again.")
@port_options
@output_option
def eeprom_restore(
    output: Output, file: Path, servos: tuple[int, ...], port: str | None, baud: int | None, config_file: str | None
) -> None:
    """Write back what differs from FILE, but id and baud; nothing is written unless every servo may be.

    Example: armctl servo eeprom restore before.yaml --servo 3
    """
    from armctl.commissioning.eeprom import load, restore
    from armctl.files import load_config

    snapshot = load(file)
    with opened(make_bus(load_config(config_file), port, baud)) as bus:
        changed = restore(bus, snapshot, servos)
    if not output.result({"restored": [asdict(difference) for difference in changed]}):
        show_differences(output, changed, "now", "was")
        output.say(f"{len(changed)} registers restored")


def show_differences(output: Output, found: Sequence[Difference], wanted: str, other: str) -> None:
    rows = [
        (
            str(one.servo_id),
            one.register,
            str(one.wanted),
            "not readable" if one.found is None else str(one.found),
        )
        for one in found
    ]
    if rows:
        show_table(output.console, "", ("servo", "register", wanted, other), rows, words=("register",))
