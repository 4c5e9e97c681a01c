"""What makes servos unfit for an arm, in words that say what to do about it."""

from typing import Protocol

from armctl.dynamixel import ax12a
from armctl.messages import Problem


class ServoJoint(Protocol):
    """What must be known of a joint to judge its servo."""

    @property
    def servo_id(self) -> int: ...

    @property
    def name(self) -> str: ...

    @property
    def limits_tick(self) -> tuple[int, int]:
        """Lowest and highest goal that the joint needs."""
        ...


def bus_dead(servos: int, garbled: bool, port_name: str, baud: int) -> Problem:
    """Why none of so many servos can be understood."""
    what = (
        f"only garbled bytes came; check that every servo runs at {baud} baud, that the adapter does not echo, the "
        "data wire and the common ground"
        if garbled
        else f"not a byte came; check that the servos' 12 V supply is on, that they run at {baud} baud, and the cable "
        "between adapter and first servo"
    )
    return Problem("BUS_DEAD", f"{port_name}: {servos} servos asked, {what}")


def slow_adapter(port_name: str, latency_ms: float, bound_ms: float) -> Problem:
    """An adapter that keeps every reply back for so long."""
    return Problem(
        "SLOW_ADAPTER",
        f"{port_name}: the adapter adds {latency_ms:.1f} ms to every reply, at most {bound_ms:.0f} ms are fit for "
        "motion; install the udev rule, or set its latency timer: "
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB*/latency_timer",
    )


def servo_silent(joint: ServoJoint) -> Problem:
    text = "no reply; check its cable, its supply, its id, and that its status return level is 2"
    return Problem("SERVO_SILENT", f"{_servo(joint)}: {text}", joint.servo_id)


def duplicate_id(joint: ServoJoint) -> Problem:
    text = "garbled replies while others answer well; two servos with this id, or a bad cable: "
    text += "connect them one at a time and give each its own id"
    return Problem("DUPLICATE_ID", f"{_servo(joint)}: {text}", joint.servo_id)


def table_problems(joint: ServoJoint, table: bytes) -> list[Problem]:
    """What in the EEPROM (bytes 0..23) of a joint's servo forbids its motion."""
    servo, servo_id = _servo(joint), joint.servo_id
    model = ax12a.register_value(ax12a.MODEL, table, 0)
    if model != ax12a.MODEL_NUMBER:
        text = f"{servo}: model number {model}, wanted {ax12a.MODEL_NUMBER} (AX-12A); use an AX-12A, or the right id"
        return [Problem("WRONG_MODEL", text, servo_id)]
    cw, ccw, level = (
        ax12a.register_value(register, table, 0) for register in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT, ax12a.RETURN_LEVEL)
    )
    low, high = joint.limits_tick
    faults = []
    if cw == ccw == 0:
        faults.append(
            f"cw_angle_limit and ccw_angle_limit are 0 (wheel mode), wanted at most {low} and at least {high}"
        )
    else:
        if cw > low:
            faults.append(f"cw_angle_limit is {cw}, wanted at most {low}")
        if ccw < high:
            faults.append(f"ccw_angle_limit is {ccw}, wanted at least {high}")
    if level != ax12a.RETURN_LEVEL.default:
        faults.append(f"status_return_level is {level}, wanted {ax12a.RETURN_LEVEL.default}")
    remedy = "; write the servo's EEPROM with its torque off, or correct the calibration file"
    return [Problem("EEPROM_MISMATCH", f"{servo}: {fault}{remedy}", servo_id) for fault in faults]


def _servo(joint: ServoJoint) -> str:
    return f"servo {joint.servo_id} ({joint.name})"
