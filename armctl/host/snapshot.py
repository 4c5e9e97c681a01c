"""The snapshot every client sees: one tick record, and how old it is, as plain JSON values; and notes in words.

Nothing here looks fresher than it is: ages grow from the last tick on, also when no tick comes any more.
"""

import math
from collections import deque
from dataclasses import replace
from typing import Any

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.control.faults import KINDS, card
from armctl.json_text import named
from armctl.kinematics.transform import matrix_from_quaternion, rpy_from_matrix
from armctl.messages import Fault, JointState, TickRecord
from armctl.recording.channels import OVERRUN_NS

STATISTICS_TICKS = 600
# Time over which the tool's speed is measured: a tick of a potentiometer is 2 mm at the tool.
SPEED_S = 0.2

# What of a note stands in the daemon's own log as well; the recorded log has all of it.
TOLD = ("event", "request", "program", "name", "step", "text", "outcome", "reasons", "who", "person", "path")
# What is told of a joint; all of them are null until its servo has answered once.
JOINT_KEYS = tuple(name for name in JointState.__slots__ if name != "known")

Point = tuple[float, float, float]


class Statistics:
    """What is remembered of the latest ticks: how they went, and how the tool moved."""

    def __init__(self) -> None:
        # Ticks the host was too slow for.
        self.dropped = 0
        self._ticks: deque[tuple[int, int, int]] = deque(maxlen=STATISTICS_TICKS)
        self._places: deque[tuple[int, Point]] = deque()
        # What `cycle` says; empty: a tick has been taken in since. Many ask within one.
        self._cycle: dict[str, int] = {}

    def see(self, record: TickRecord) -> None:
        """Take one tick in."""
        sample, self._cycle = record.inputs.sample, {}
        self.dropped += record.dropped
        self._ticks.append((sample.bus_us, record.lateness_us, sample.retries))
        if record.outputs.tool is None or record.dropped:
            self._places.clear()
        if record.outputs.tool is not None:
            self._places.append((sample.time_ns, record.outputs.tool.position_m))
        while len(self._places) > 2 and sample.time_ns - self._places[1][0] >= SPEED_S * NS_PER_S:
            self._places.popleft()

    def tool_speed_m_s(self) -> float | None:
        """The tool's mean speed over the last `SPEED_S`, or as long as it is known; None: unknown."""
        if len(self._places) < 2:
            return None
        (begin_ns, begin), (end_ns, end) = self._places[0], self._places[-1]
        return math.dist(begin, end) * NS_PER_S / max(1, end_ns - begin_ns)

    def cycle(self) -> dict[str, int]:
        """Bus and timing figures of the last minute (at 10 Hz), and how long the bus took in the last tick."""
        if self._cycle:
            return self._cycle
        bus_us, lateness_us, retries = zip(*self._ticks, strict=True) if self._ticks else ((0,),) * 3
        self._cycle = {
            "bus_us": bus_us[-1],
            "bus_us_p50": _percentile(bus_us, 50),
            "bus_us_p99": _percentile(bus_us, 99),
            "lateness_us_p99": _percentile(lateness_us, 99),
            "overruns": sum(late > OVERRUN_NS // 1000 for late in lateness_us),
            "retries": sum(retries),
        }
        return self._cycle


def arm_snapshot(arm: ArmConfig, latest: TickRecord | None, statistics: Statistics, now_ns: int) -> dict[str, Any]:
    """Tick, joints, tool and motion, as of now."""
    age_s = None if latest is None else max(0, now_ns - latest.inputs.now_ns) / NS_PER_S
    nothing: tuple[None, ...] = (None,) * len(arm.joints)
    states = nothing if latest is None else latest.outputs.joints
    wanted = nothing if latest is None else latest.outputs.wanted_rad or nothing
    pose = None if latest is None else latest.outputs.tool
    tool = pose and {
        "position_m": list(pose.position_m),
        "rpy_rad": list(rpy_from_matrix(matrix_from_quaternion(pose.quaternion))),
        "speed_m_s": statistics.tool_speed_m_s(),
    }
    return {
        "tick": None if latest is None else latest.inputs.tick,
        "age_s": age_s,
        "joints": [
            {"name": joint.name, "servo_id": joint.servo_id, "limits_rad": joint.limits_rad, "wanted_rad": q_rad}
            | _joint(state, age_s)
            for joint, state, q_rad in zip(arm.joints, states, wanted, strict=True)
        ],
        "tool": tool,
        "cycle": statistics.cycle(),
        "progress": None if latest is None else latest.outputs.progress,
        "rate": None if latest is None else latest.outputs.rate,
    }


def fault_snapshots(latest: TickRecord | None, lost_ns: int | None, now_ns: int) -> list[dict[str, Any]]:
    """The card of every fault that is latched, the worst first.

    Args:
        lost_ns: Since when there is no control process; None: there is one.
    """
    cards = []
    if lost_ns is not None:
        fault = Fault("RESTARTED", "the control process died; a new one is being started", lost_ns)
        arm = "still; every servo keeps its last goal with the torque it has"
        cards.append(_card(fault, (arm, "wait a second, then type `armctl status`"), now_ns))
    if latest is not None:
        now, heard = latest.outputs, any(reading.fresh for reading in latest.inputs.sample.servos)
        for fault in now.faults:
            # Of an arm that is heard again a lost port says what any other fault of the bus does.
            cause = replace(fault, code="BUS_DEAD") if heard and fault.code == "PORT_GONE" else fault
            arm, _ = card(cause, now.joints, now.progress is not None, now.rest_in_s)
            cards.append(_card(fault, (arm, KINDS[fault.code].remedy), now_ns))
    return cards


def note_words(message: dict[str, Any]) -> str:
    """What a person reads of a note that goes into the log."""
    words = (message[key] for key in TOLD if message.get(key))
    return ", ".join("; ".join(word) if isinstance(word, list) else str(word) for word in words)


def _card(fault: Fault, told: tuple[str, str], now_ns: int) -> dict[str, Any]:
    return {
        **named(fault, "code", "servo_id", "text"),
        "since_s": max(0, now_ns - fault.since_ns) / NS_PER_S,
        "arm": told[0],
        "next": told[1],
        "follows": fault.follows or None,
    }


def _joint(state: JointState | None, tick_age_s: float | None) -> dict[str, Any]:
    if state is None or tick_age_s is None or not state.known:
        return dict.fromkeys(JOINT_KEYS)
    return {**named(state, *JOINT_KEYS), "age_s": state.age_s + tick_age_s}


def _percentile(values: tuple[int, ...], percent: int) -> int:
    return sorted(values)[(len(values) - 1) * percent // 100]
