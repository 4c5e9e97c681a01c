"""The table of two servos on one joint: what both read while a hand leads the limp joint through its range.

Readings are gathered in bins of the first servo's, and each bin that was passed often enough is a row, the mean of it.
There and back, the time between the two readings falls out of that.
"""

import numpy as np

from armctl.clock import NS_PER_S
from armctl.commissioning.calibration import READING_PERIOD_NS, limp_ticks
from armctl.commissioning.finding import Opened, Person
from armctl.commissioning.texts import refusal, said
from armctl.config import ArmConfig, Servo, validate
from armctl.dynamixel.bus import ServoBus
from armctl.errors import ConfigError

BIN_TICK, LEAST_READINGS = 24, 4
# A joint that was led by less has not been shown; one that has is done with once it stands for so long.
LEAST_TICK, STILL_TICK = 200, 3
STANDS, LONGEST = 2 * NS_PER_S // READING_PERIOD_NS, 120 * NS_PER_S // READING_PERIOD_NS


def measured(arm: ArmConfig, opened: Opened, person: Person) -> ArmConfig:
    """The arm with a table of every pair that turns one shaft.

    Raises:
        RequestRefused: a joint was not led through its range, or a servo is silent or has torque.
        ConfigError: there is no pair, or what was measured is none.
        PortGone: the port vanished.
    """
    told = arm.model_dump(mode="json", exclude_unset=True)
    pairs = [(arm.servos[a], arm.servos[b]) for a, b in arm.rigid_pairs]
    if not pairs:
        raise ConfigError(arm.arm_id, "pair", "no joint of this arm has two servos", "see `armctl help new-arm`")
    for first, second in pairs:
        person.ask(f"{first.name}.pair", said("pair", name=first.name))
        with opened([first.servo_id, second.servo_id]) as bus:
            told["joints"][first.of]["pair"] = {"servo_id": second.servo_id, "table": _led(bus, first, second)}
    return validate(ArmConfig, told, "what was measured")


def _led(bus: ServoBus, *servos: Servo) -> list[list[float]]:
    """What both servos of a joint read at the same places, once it has been led and stands again."""
    clock, rows = bus.port.clock, np.zeros((0, 2))
    begin_ns = clock.now_ns()
    while len(rows) < STANDS or np.ptp(rows[:, 0]) < LEAST_TICK or np.ptp(rows[-STANDS:, 0]) > STILL_TICK:
        if len(rows) == LONGEST:
            raise refusal("NOT_SHOWN pair", name=servos[0].name)
        clock.sleep_until_ns(begin_ns + (len(rows) + 1) * READING_PERIOD_NS)
        rows = np.vstack((rows, limp_ticks(bus, servos)))
    bins, table = rows[:, 0] // BIN_TICK, list[list[float]]()
    for inside in (rows[bins == one] for one in np.unique(bins)):
        row = inside.mean(axis=0).round(1).tolist()
        # Of two places close together noise would make the slope.
        if len(inside) >= LEAST_READINGS and (not table or row[0] - table[-1][0] >= BIN_TICK / 2):
            table.append(row)
    return table
