"""The simulator's own control socket: what no servo can tell or do.

A Unix stream socket; one JSON object a line each way, answered in order:

    {"method": "guide", "params": {"from": [x, y, z], "to": [x, y, z], "seed": 1, "duration_s": 5.0}}
        -> {"result": {"duration_s": s, "begin_s": s, "end_s": s}}    once the hand has begun; "duration_s" is optional
    {"method": "hold", "params": {"joints_rad": [...], "free": n}}
        -> {"result": {"duration_s", "begin_s", "end_s"}}    the joints are there then; "free", an index, is optional
    let_go, unplug, replug
        -> {"result": {}}
    state
        -> {"result": {"time_ns", "time_s", "joints_rad", "tool_m", "plugged", "guided", "joints": [...], "gripper",
            "servos": [...]}}
    truth {"begin_ns", "end_ns"}
        -> {"result": {"time_ns": [...], "tool_m": [[x, y, z], ...], "joints_rad": [[...], ...]}}
    fault_begin {"kind", "servo_id", "probability", "count", "begin_s", "duration_s", "value"}
        -> {"result": {"id": n}}    all but the kind optional, see `faults.Fault`; "begin_s" counts from now
    fault_end {"id": n}
        -> {"result": {}}
    faults
        -> {"result": {"faults": [{"id", "kind", ..., "begin_s", "end_s", "active", "struck"}, ...]}}

A refusal is {"error": "why"}. Times in ns are CLOCK_MONOTONIC, "time_s" and a fault's are the simulator's own; truth is
kept every 10 ms for `TRUTH_S`. Long answers leave in small pieces between the bus's business, since a servo does not
wait for a program to write JSON.
"""

import json
import math
import socket
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from armctl.clock import NS_PER_S
from armctl.config import validate
from armctl.dynamixel import ax12a
from armctl.errors import ArmctlError, PortMissing, RequestRefused
from armctl.json_text import named
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault, check_servo
from armctl.sim.hand import Guided

# So much of the truth is kept [s], a sample every so many nanoseconds.
TRUTH_S = 1200
TRUTH_PERIOD_NS = 10_000_000
PIECE_SAMPLES = 100
# What is told of a servo beside some registers.
SERVO = ("servo_id", "torque_enabled", "position_tick", "output", "voltage_V", "temperature_degC", "led")
# Longest wait of a client for an answer.
ANSWER_S = 10.0

Params = dict[str, Any]
# A monotonic instant [ns], and the true joint positions [rad] of then, shape (n,).
Sample = tuple[int, FloatArray]


def control_path(link: Path) -> Path:
    """The control socket of the simulator that publishes `link`."""
    return link.with_name(f"{link.name}.control")


class Truth(NamedTuple):
    """What really happened, every 10 ms."""

    # Monotonic, shape (m,).
    time_ns: NDArray[np.int64]
    # Shape (m, 3).
    tool_m: FloatArray
    # Shape (m, n).
    joints_rad: FloatArray


class TruthRing:
    """True joint positions, the newest `TRUTH_S` of them."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=TRUTH_S * NS_PER_S // TRUTH_PERIOD_NS)

    def add(self, time_ns: int, joints_rad: FloatArray) -> None:
        """Keep one sample; times must not decrease."""
        self._samples.append((time_ns, joints_rad))

    def between(self, begin_ns: int, end_ns: int) -> list[Sample]:
        """Those kept with begin_ns <= time <= end_ns."""
        begin = bisect_left(self._samples, begin_ns, key=itemgetter(0))
        return list(islice(self._samples, begin, bisect_right(self._samples, end_ns, key=itemgetter(0))))


class Plug(Protocol):
    """The port the simulated adapter shows to the host."""

    @property
    def plugged(self) -> bool: ...

    def unplug(self) -> None: ...

    def replug(self) -> None: ...


class Controls:
    """The methods of the control socket, on one simulated arm."""

    def __init__(self, arm: SimulatedArm, ring: TruthRing, plug: Plug, now_ns: Callable[[], int]) -> None:
        self._arm, self._ring, self._plug, self._now_ns = arm, ring, plug, now_ns
        # What gives the result of each method, and the parameters it knows (None: it checks them itself).
        self._methods: dict[str, tuple[Callable[[Params], Params | Iterator[str] | None], tuple[str, ...] | None]] = {
            "guide": (self._guide, ("from", "to", "seed", "duration_s")),
            "hold": (self._hold, ("joints_rad", "free")),
            "let_go": (lambda _: arm.hand.release(), ()),
            "truth": (self._truth, ("begin_ns", "end_ns")),
            "state": (self._state, ()),
            "unplug": (lambda _: plug.unplug(), ()),
            "replug": (lambda _: plug.replug(), ()),
            "fault_begin": (self._fault_begin, None),
            "fault_end": (self._fault_end, ("id",)),
            "faults": (lambda _: {"faults": arm.faults.listing()}, ()),
        }

    def answer(self, line: bytes) -> Iterator[str]:
        """Pieces of the line that answers a request line; refusals are answers too."""
        try:
            request = json.loads(line)
            if not isinstance(request, dict) or request.get("method") not in self._methods:
                raise ValueError(f"a request is an object with a method; known: {', '.join(self._methods)}")
            params = request.get("params", {})
            if not isinstance(params, dict):
                raise ValueError("params must be an object")
            method, known = self._methods[request["method"]]
            self._arm.advance(self._now_ns())
            for key in params:
                if known is not None and key not in known:
                    raise ValueError(f"unknown parameter {key!r}; known: {', '.join(known) or 'none'}")
            result = method(params)
        except (ValueError, RecursionError, ArmctlError) as error:
            return iter((json.dumps({"error": str(error)}),))
        return result if isinstance(result, Iterator) else iter((json.dumps({"result": result or {}}),))

    def _guide(self, params: Params) -> Params:
        seed, duration_s = params.get("seed"), params.get("duration_s")
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed {seed!r}: a whole number of at least 0")
        line = _point(params, "from"), _point(params, "to")
        duration_s = None if duration_s is None else _number(duration_s, "duration_s")
        return self._arm.hand.guide(*line, seed=seed, duration_s=duration_s)._asdict()

    def _hold(self, params: Params) -> Params:
        wanted, free, n = params.get("joints_rad"), params.get("free"), len(self._arm.config.joints)
        if not isinstance(wanted, list) or len(wanted) != n:
            raise ValueError(f"joints_rad {wanted!r}: {n} numbers, rad")
        if free is not None and free not in range(n):
            raise ValueError(f"free {free!r}: the index of a joint, 0 to {n - 1}")
        return self._arm.hand.hold(np.array([_number(q, "joints_rad") for q in wanted]), free)._asdict()

    def _fault_begin(self, params: Params) -> Params:
        fault = validate(Fault, params, "fault")
        check_servo(fault, self._arm.config.servo_ids, "fault", "servo_id")
        number = self._arm.faults.begin(fault, self._arm.time_s)
        self._arm.advance(self._now_ns())
        return {"id": number}

    def _fault_end(self, params: Params) -> None:
        number = params.get("id")
        if type(number) is not int:
            raise ValueError(f"id {number!r}: the number that fault_begin gave")
        self._arm.faults.end(number)
        self._arm.advance(self._now_ns())

    def _state(self, _: Params) -> Params:
        now_ns, config = self._now_ns(), self._arm.config
        self._arm.advance(now_ns)
        return {
            "time_ns": now_ns,
            "time_s": self._arm.time_s,
            "joints_rad": self._arm.true_positions().tolist(),
            "tool_m": self._arm.true_tool_position().tolist(),
            "plugged": self._plug.plugged,
            "guided": self._arm.hand.holding,
            "joints": [joint.model_dump(include={"name", "limits_deg", "rest_deg"}) for joint in config.joints],
            "gripper": config.gripper and config.gripper.model_dump(include={"joint", "open_deg", "closed_deg"}),
            "servos": [
                named(servo, *SERVO)
                | {"goal_tick": servo.get(ax12a.GOAL), "torque_limit": servo.get(ax12a.TORQUE_LIMIT)}
                for servo in self._arm.servos
            ],
        }

    def _truth(self, params: Params) -> Iterator[str]:
        between_ns = (round(_number(params.get(key), key)) for key in ("begin_ns", "end_ns"))
        return self._truth_pieces(self._ring.between(*between_ns))

    def _truth_pieces(self, samples: list[Sample]) -> Iterator[str]:
        columns: dict[str, Callable[[list[Sample]], list[Any]]] = {
            "time_ns": lambda part: [time_ns for time_ns, _ in part],
            "tool_m": lambda part: self._arm.tool_positions(np.array([joints for _, joints in part])).tolist(),
            "joints_rad": lambda part: [joints.tolist() for _, joints in part],
        }
        opening = '{"result": {'
        for name, values in columns.items():
            yield f'{opening}"{name}": ['
            for begin in range(0, len(samples), PIECE_SAMPLES):
                text = json.dumps(values(samples[begin : begin + PIECE_SAMPLES]))[1:-1]
                yield text if begin == 0 else f", {text}"
            opening = "], "
        yield "]}}"


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{what} {value!r} is no number")
    return value


def _point(params: Params, key: str) -> FloatArray:
    value = params.get(key)
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{key} {value!r}: three numbers, metres in the base frame")
    return np.array([_number(x, key) for x in value], dtype=np.float64)


class SimulatorClient(AbstractContextManager["SimulatorClient"]):
    """A synchronous client of a simulator's control socket."""

    def __init__(self, path: Path | str) -> None:
        """Connect to the control socket at `path` (see `control_path`).

        Raises:
            PortMissing: no simulator listens there.
        """
        self._path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(ANSWER_S)
        try:
            self._socket.connect(self._path)
        except OSError as error:
            self._socket.close()
            problem = f"no simulator listens here ({error.strerror or error})"
            raise PortMissing(f"{path}: {problem}; start one with `armctl sim --link`") from None
        self._stream = self._socket.makefile("rb")

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Hang up; the arm is not let go."""
        self._stream.close()
        self._socket.close()

    def guide(
        self, from_m: Sequence[float], to_m: Sequence[float], seed: int, duration_s: float | None = None
    ) -> Guided:
        """Let the hand begin a take along the line from `from_m` to `to_m` [m]; times count from now.

        Raises:
            RequestRefused: an end is out of reach or a parameter is not acceptable.
        """
        line = {"from": [float(x) for x in from_m], "to": [float(x) for x in to_m]}
        return Guided(**self._call("guide", **line, seed=seed, duration_s=duration_s))

    def hold(self, joints_rad: Sequence[float], free: int | None = None) -> Guided:
        """Let the hand lead the joints to positions [rad] and hold them there, but for one that it leaves free.

        Raises:
            RequestRefused: a parameter is not acceptable.
        """
        return Guided(**self._call("hold", joints_rad=[float(q) for q in joints_rad], free=free))

    def let_go(self) -> None:
        """Take the hand off the arm."""
        self._call("let_go")

    def truth(self, begin_ns: int, end_ns: int) -> Truth:
        """True motion between two monotonic instants, as far as it is kept."""
        result = self._call("truth", begin_ns=begin_ns, end_ns=end_ns)
        time_ns = np.array(result["time_ns"], dtype=np.int64)
        tool_m, joints_rad = (np.array(result[key], dtype=np.float64) for key in ("tool_m", "joints_rad"))
        return Truth(time_ns, tool_m.reshape(-1, 3), joints_rad.reshape(len(time_ns), -1 if len(time_ns) else 0))

    def state(self) -> dict[str, Any]:
        """True joints, tool, and what each servo's registers hold."""
        return self._call("state")

    def unplug(self) -> None:
        """Pull the adapter out of the host: the port vanishes, the servos keep their power."""
        self._call("unplug")

    def replug(self) -> None:
        """Put the adapter back; the link names a new port."""
        self._call("replug")

    def fault_begin(self, kind: str, **fields: float | None) -> int:
        """Let a fault begin, now unless a `begin_s` is among its fields; its number.

        Args:
            fields: The other fields of `faults.Fault`, by name.
        Raises:
            RequestRefused: no such kind, field or servo, or a value out of range.
        """
        return int(self._call("fault_begin", kind=kind, **fields)["id"])

    def fault_end(self, id: int) -> None:
        """End a fault; one that is over already is left so.

        Raises:
            RequestRefused: there never was a fault of this number.
        """
        self._call("fault_end", id=id)

    def faults(self) -> list[dict[str, Any]]:
        """Every fault planned or in force, see `faults.Faults.listing`."""
        return list(self._call("faults")["faults"])

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        try:
            self._socket.sendall(json.dumps({"method": method, "params": params}).encode() + b"\n")
            line = self._stream.readline()
        except OSError as error:
            raise PortMissing(f"{self._path}: the simulator does not answer {method} ({error})") from None
        if not line.endswith(b"\n"):
            raise PortMissing(f"{self._path}: the simulator hung up during {method}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RequestRefused("SIMULATOR", answer["error"])
        return dict(answer["result"])
