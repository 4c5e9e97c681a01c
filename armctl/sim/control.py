"""The simulator's own control socket: what no servo can tell or do.

A Unix stream socket; one JSON object a line each way, answered in order:

    {"method": "guide", "params": {"from": [x, y, z], "to": [x, y, z], "seed": 1, "duration_s": 5.0}}
        -> {"result": {"duration_s": s, "begin_s": s, "end_s": s}}    once the hand has begun; "duration_s" is optional
    let_go, unplug, replug
        -> {"result": {}}
    state
        -> {"result": {"time_ns", "time_s", "joints_rad", "tool_m", "plugged", "guided", "servos": [...]}}
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

from __future__ import annotations

import contextlib
import json
import math
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from armctl.config import validate
from armctl.dynamixel import ax12a
from armctl.errors import ArmctlError, ConfigError, PortBusy, PortMissing, RequestRefused
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault, check_servo
from armctl.sim.hand import Guided

TRUTH_S = 1200
TRUTH_PERIOD_NS = 10_000_000
MAX_LINE_BYTES = 65536
MAX_PATH_BYTES = 107
PIECE_SAMPLES = 100


def control_path(link: Path) -> Path:
    """The control socket of the simulator that publishes `link`."""
    return link.with_name(f"{link.name}.control")


class TruthRing:
    """True joint positions, the newest `TRUTH_S` of them."""

    def __init__(self, joints: int) -> None:
        size = TRUTH_S * 1_000_000_000 // TRUTH_PERIOD_NS
        self._time_ns = np.zeros(size, dtype=np.int64)
        self._joints_rad = np.zeros((size, joints))
        self._count = 0

    def add(self, time_ns: int, joints_rad: FloatArray) -> None:
        """Keep one sample; times must not decrease."""
        at = self._count % self._time_ns.size
        self._time_ns[at] = time_ns
        self._joints_rad[at] = joints_rad
        self._count += 1

    def between(self, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], FloatArray]:
        """Times [ns], shape (m,), and joint positions [rad], shape (m, n), with begin_ns <= time <= end_ns."""
        size = self._time_ns.size
        oldest = max(0, self._count - size)
        order = np.arange(oldest, self._count) % size
        times = self._time_ns[order]
        chosen = order[np.searchsorted(times, begin_ns) : np.searchsorted(times, end_ns, side="right")]
        return self._time_ns[chosen], self._joints_rad[chosen]


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
        self._methods: dict[str, Callable[[dict[str, Any]], Iterator[str]]] = {
            "guide": self._guide,
            "let_go": self._let_go,
            "truth": self._truth,
            "state": self._state,
            "unplug": self._unplug,
            "replug": self._replug,
            "fault_begin": self._fault_begin,
            "fault_end": self._fault_end,
            "faults": self._faults,
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
            return self._methods[request["method"]](params)
        except (ValueError, RecursionError, ArmctlError) as error:
            return _piece({"error": str(error)})

    def _guide(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params, "from", "to", "seed", "duration_s")
        seed, duration_s = params.get("seed"), params.get("duration_s")
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed {seed!r}: a whole number of at least 0")
        self._arm.advance(self._now_ns())
        guided = self._arm.hand.guide(
            _point(params, "from"),
            _point(params, "to"),
            seed=seed,
            duration_s=None if duration_s is None else _number(duration_s, "duration_s"),
        )
        return _piece({"result": asdict(guided)})

    def _let_go(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params)
        self._arm.hand.release()
        return _piece({"result": {}})

    def _unplug(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params)
        self._plug.unplug()
        return _piece({"result": {}})

    def _replug(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params)
        self._plug.replug()
        return _piece({"result": {}})

    def _fault_begin(self, params: dict[str, Any]) -> Iterator[str]:
        fault = validate(Fault, params, "fault")
        check_servo(fault, self._arm.config.servo_ids, "fault", "servo_id")
        now_ns = self._now_ns()
        self._arm.advance(now_ns)
        number = self._arm.faults.begin(fault, self._arm.time_s)
        self._arm.advance(now_ns)
        return _piece({"result": {"id": number}})

    def _fault_end(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params, "id")
        number = params.get("id")
        if type(number) is not int:
            raise ValueError(f"id {number!r}: the number that fault_begin gave")
        self._arm.faults.end(number)
        self._arm.advance(self._now_ns())
        return _piece({"result": {}})

    def _faults(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params)
        self._arm.advance(self._now_ns())
        return _piece({"result": {"faults": self._arm.faults.listing()}})

    def _state(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params)
        now_ns = self._now_ns()
        self._arm.advance(now_ns)
        servos = [
            {
                "servo_id": servo.get(ax12a.ID),
                "torque_enabled": servo.torque_enabled,
                "goal_tick": servo.get(ax12a.GOAL),
                "position_tick": servo.position_tick,
                "output": servo.output,
                "torque_limit": servo.get(ax12a.TORQUE_LIMIT),
                "voltage_V": servo.voltage_V,
                "temperature_degC": servo.temperature_degC,
                "led": servo.led,
            }
            for servo in self._arm.servos
        ]
        result = {
            "time_ns": now_ns,
            "time_s": self._arm.time_s,
            "joints_rad": self._arm.true_positions().tolist(),
            "tool_m": self._arm.true_tool_position().tolist(),
            "plugged": self._plug.plugged,
            "guided": self._arm.hand.holding,
            "servos": servos,
        }
        return _piece({"result": result})

    def _truth(self, params: dict[str, Any]) -> Iterator[str]:
        _only(params, "begin_ns", "end_ns")
        begin_ns, end_ns = (round(_number(params.get(key), key)) for key in ("begin_ns", "end_ns"))
        return self._truth_pieces(*self._ring.between(begin_ns, end_ns))

    def _truth_pieces(self, times_ns: NDArray[np.int64], joints_rad: FloatArray) -> Iterator[str]:
        columns: tuple[tuple[str, Callable[[slice], list[Any]]], ...] = (
            ("time_ns", lambda part: times_ns[part].tolist()),
            ("tool_m", lambda part: self._arm.tool_positions(joints_rad[part]).tolist()),
            ("joints_rad", lambda part: joints_rad[part].tolist()),
        )
        opening = '{"result": {'
        for name, values in columns:
            yield f'{opening}"{name}": ['
            for begin in range(0, len(times_ns), PIECE_SAMPLES):
                text = json.dumps(values(slice(begin, begin + PIECE_SAMPLES)))[1:-1]
                yield text if begin == 0 else f", {text}"
            opening = "], "
        yield "]}}"


def _piece(answer: dict[str, Any]) -> Iterator[str]:
    return iter((json.dumps(answer),))


def _only(params: dict[str, Any], *known: str) -> None:
    for key in params:
        if key not in known:
            raise ValueError(f"unknown parameter {key!r}; known: {', '.join(known) or 'none'}")


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{what} {value!r} is no number")
    return value


def _point(params: dict[str, Any], key: str) -> FloatArray:
    value = params.get(key)
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{key} {value!r}: three numbers, metres in the base frame")
    return np.array([_number(x, key) for x in value], dtype=np.float64)


@dataclass
class _Connection:
    incoming: bytearray
    outgoing: bytearray
    answers: list[Iterator[str]]

    @property
    def busy(self) -> bool:
        return bool(self.outgoing or self.answers)


class ControlServer:
    """The listening socket and its clients, served without ever blocking."""

    def __init__(self, path: Path, answer: Callable[[bytes], Iterator[str]]) -> None:
        """Listen on `path`; a dead simulator's socket there is replaced.

        Raises:
            ConfigError: the path is too long or cannot be created.
            PortBusy: another simulator listens there.
        """
        if len(str(path).encode()) > MAX_PATH_BYTES:
            raise ConfigError(
                str(path), "", f"longer than the {MAX_PATH_BYTES} bytes of a socket's name", "shorten --link"
            )
        self._path, self._answer = path, answer
        self._connections: dict[socket.socket, _Connection] = {}
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_socket():
                with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                    if probe.connect_ex(str(path)) == 0:
                        raise PortBusy(f"{path}: another simulator runs here; stop it or choose another --link")
                path.unlink()
            self._listener.bind(str(path))
        except OSError as error:
            self._listener.close()
            raise ConfigError(str(path), "", f"cannot listen: {error.strerror}") from None
        except PortBusy:
            self._listener.close()
            raise
        self._listener.listen()
        self._listener.setblocking(False)

    def readers(self) -> list[socket.socket]:
        """Sockets to wait on for reading; a client with an answer under way is not heard."""
        return [self._listener, *(s for s, connection in self._connections.items() if not connection.busy)]

    def writers(self) -> list[socket.socket]:
        """Sockets to wait on for writing."""
        return [s for s, connection in self._connections.items() if connection.busy]

    def serve(self, ready: Sequence[socket.socket]) -> None:
        """Read from and write to the sockets that are ready, a little of each."""
        for sock in ready:
            if sock is self._listener:
                with contextlib.suppress(BlockingIOError):
                    accepted, _ = self._listener.accept()
                    accepted.setblocking(False)
                    self._connections[accepted] = _Connection(bytearray(), bytearray(), [])
                continue
            connection = self._connections[sock]
            try:
                if connection.busy:
                    self._send(sock, connection)
                else:
                    self._receive(sock, connection)
            except BlockingIOError:
                pass
            except OSError:
                self._drop(sock)

    def close(self) -> None:
        """Drop every client and remove the socket."""
        for sock in list(self._connections):
            self._drop(sock)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _drop(self, sock: socket.socket) -> None:
        del self._connections[sock]
        sock.close()

    def _receive(self, sock: socket.socket, connection: _Connection) -> None:
        data = sock.recv(MAX_LINE_BYTES)
        connection.incoming += data
        *lines, rest = connection.incoming.split(b"\n")
        if not data or len(rest) > MAX_LINE_BYTES:
            self._drop(sock)
            return
        connection.incoming = bytearray(rest)
        connection.answers += [self._answer(bytes(line)) for line in lines]

    def _send(self, sock: socket.socket, connection: _Connection) -> None:
        if not connection.outgoing:
            piece = next(connection.answers[0], None)
            if piece is None:
                del connection.answers[0]
                piece = "\n"
            connection.outgoing += piece.encode()
        del connection.outgoing[: sock.send(connection.outgoing)]


@dataclass(frozen=True)
class Truth:
    """What really happened, every 10 ms."""

    time_ns: NDArray[np.int64]
    """Monotonic, shape (m,)."""
    tool_m: FloatArray
    """Shape (m, 3)."""
    joints_rad: FloatArray
    """Shape (m, n)."""


class SimulatorClient:
    """A synchronous client of a simulator's control socket."""

    def __init__(self, path: Path | str, *, timeout_s: float = 10.0) -> None:
        """Connect to the control socket at `path` (see `control_path`).

        Raises:
            PortMissing: no simulator listens there.
        """
        self._path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(self._path)
        except OSError as error:
            self._socket.close()
            raise PortMissing(
                f"{path}: no simulator listens here ({error.strerror or error}); start one with `armctl sim --link`"
            ) from None
        self._stream = self._socket.makefile("rb")

    def __enter__(self) -> SimulatorClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        params = {"from": [float(x) for x in from_m], "to": [float(x) for x in to_m], "seed": seed}
        return Guided(**self._call("guide", params if duration_s is None else {**params, "duration_s": duration_s}))

    def let_go(self) -> None:
        """Take the hand off the arm."""
        self._call("let_go")

    def truth(self, begin_ns: int, end_ns: int) -> Truth:
        """True motion between two monotonic instants, as far as it is kept."""
        result = self._call("truth", {"begin_ns": begin_ns, "end_ns": end_ns})
        time_ns = np.array(result["time_ns"], dtype=np.int64)
        tool_m = np.array(result["tool_m"], dtype=np.float64).reshape(len(time_ns), 3)
        joints_rad = np.array(result["joints_rad"], dtype=np.float64).reshape(len(time_ns), -1 if len(time_ns) else 0)
        return Truth(time_ns, tool_m, joints_rad)

    def state(self) -> dict[str, Any]:
        """True joints, tool, and what each servo's registers hold."""
        return self._call("state")

    def unplug(self) -> None:
        """Pull the adapter out of the host: the port vanishes, the servos keep their power."""
        self._call("unplug")

    def replug(self) -> None:
        """Put the adapter back; the link names a new port."""
        self._call("replug")

    def fault_begin(
        self,
        kind: str,
        *,
        servo_id: int | None = None,
        probability: float = 1.0,
        count: int | None = None,
        duration_s: float | None = None,
        value: float | None = None,
    ) -> int:
        """Let a fault begin now, see `faults.Fault`; its number.

        Raises:
            RequestRefused: no such kind or servo, or a parameter out of range.
        """
        params = {"kind": kind, "servo_id": servo_id, "probability": probability, "count": count}
        number: int = self._call("fault_begin", {**params, "duration_s": duration_s, "value": value})["id"]
        return number

    def fault_end(self, id: int) -> None:
        """End a fault; one that is over already is left so.

        Raises:
            RequestRefused: there never was a fault of this number.
        """
        self._call("fault_end", {"id": id})

    def faults(self) -> list[dict[str, Any]]:
        """Every fault planned or in force, see `faults.Faults.listing`."""
        listing: list[dict[str, Any]] = self._call("faults")["faults"]
        return listing

    def _call(self, method: str, params: dict[str, Any] | None = None) -> dict[str, Any]:
        try:
            self._socket.sendall(json.dumps({"method": method, "params": params or {}}).encode() + b"\n")
            line = self._stream.readline()
        except OSError as error:
            raise PortMissing(f"{self._path}: the simulator does not answer {method} ({error})") from None
        if not line.endswith(b"\n"):
            raise PortMissing(f"{self._path}: the simulator hung up during {method}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RequestRefused("SIMULATOR", answer["error"])
        result: dict[str, Any] = answer["result"]
        return result
