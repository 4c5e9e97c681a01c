"""JSON-RPC 2.0, one object a line, read strictly and without I/O.

Rules.
1. A line is at most 64 KiB of UTF-8 and holds one request object; batches are refused.
2. Numbers are finite (`NaN`, `Infinity` and 1e999 are refused), no key appears twice, nesting is at most 16 deep, and a
   text holds no half of a surrogate pair, so that it can be written again.
3. A request without `id` is a notification: it is carried out and not answered.
4. Failures of the protocol have the standard's codes; failures of armctl are -32000. Both carry in `data` what
   a client needs to raise the same error: `code`, `reasons`, `exit_status`, and `type` and `fields` of the class.
"""

import json
import math
import re
from typing import Any, NamedTuple, NoReturn

from armctl.config import NAME_PATTERN
from armctl.errors import ArmctlError, BusError, ConfigError, LogError, NoDaemon, NoWayIn, RequestRefused
from armctl.strict_yaml import keys_once

MAX_LINE_BYTES = 65536
MAX_DEPTH = 16

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
ARMCTL_ERROR = -32000

_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+"')
_AS_LISTS = bytes.maketrans(b"{}", b"[]")
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))

RequestId = int | str | None


class Request(NamedTuple):
    """One request; `id` means nothing when `answered` is False."""

    method: str
    params: dict[str, Any]
    id: RequestId = None
    answered: bool = True
    # For whom it is asked, as the client says.
    person: str = ""


class ProtocolError(Exception):
    """A line that is no request; `number` is the standard's error code, `id` the request's where it could be read."""

    def __init__(self, number: int, problem: str, request_id: RequestId = None) -> None:
        self.number, self.problem, self.id = number, problem, request_id
        super().__init__(problem)


def decode(line: bytes) -> Request:
    """The request in one line.

    Raises:
        ProtocolError: it is not strict JSON, or not a request.
    """
    message = strict_json(line)
    if not isinstance(message, dict):
        what = "a batch" if isinstance(message, list) else f"a {type(message).__name__}"
        raise ProtocolError(INVALID_REQUEST, f"a line holds one request object, not {what}")
    request_id = message.get("id")
    if isinstance(request_id, bool) or not isinstance(request_id, int | str | None):
        raise ProtocolError(INVALID_REQUEST, f"id: a whole number or a text, not {_shown(request_id)}")

    def refuse(problem: str) -> NoReturn:
        raise ProtocolError(INVALID_REQUEST, problem, request_id)

    if message.get("jsonrpc") != "2.0":
        refuse(f'jsonrpc: must be "2.0", not {_shown(message.get("jsonrpc"))}')
    method = message.get("method")
    if not isinstance(method, str):
        refuse(f"method: a text, not {_shown(method)}")
    params = message.get("params", {})
    if not isinstance(params, dict):
        refuse(f"params: an object of named parameters, not {_shown(params)}")
    person = message.get("person", "")
    if not isinstance(person, str) or (person and not re.fullmatch(NAME_PATTERN, person)):
        refuse(f"person: a name, not {_shown(person)}")
    if unknown := message.keys() - {"jsonrpc", "id", "method", "params", "person"}:
        refuse(f"{min(unknown)}: unknown key; a request has jsonrpc, id, method, params, person")
    return Request(method, params, request_id, "id" in message, person)


def strict_json(line: bytes) -> object:
    """The value in a text of JSON, by rules 1 and 2.

    Raises:
        ProtocolError: it breaks them.
    """
    if len(line) > MAX_LINE_BYTES:
        raise ProtocolError(PARSE_ERROR, f"the line is {len(line)} bytes long; {MAX_LINE_BYTES} are allowed")
    try:
        message = json.loads(
            line.decode("utf-8"), object_pairs_hook=keys_once, parse_float=_finite, parse_constant=_no_nan
        )
    except (ValueError, RecursionError) as error:
        text = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ProtocolError(PARSE_ERROR, f"not strict JSON: {text[:200]}") from None
    if _deeper_than(line, MAX_DEPTH):
        raise ProtocolError(PARSE_ERROR, f"not strict JSON: nested more than {MAX_DEPTH} deep")
    if b"\\u" in line:
        try:
            json.dumps(message, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise ProtocolError(PARSE_ERROR, "not strict JSON: half of a surrogate pair in a text") from None
    return message


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:60]} is not a finite number")
    return value


def _no_nan(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number")


def _deeper_than(text: bytes, depth: int) -> bool:
    """Whether objects and lists stand in one another more than `depth` deep in a text that is JSON."""
    brackets = _STRING.sub(b"", text).translate(_AS_LISTS, _NO_BRACKETS)
    for _ in range(depth):
        brackets = brackets.replace(b"[]", b"")  # the innermost ones
    return bool(brackets)


def _shown(value: object) -> str:
    return repr(value)[:60]


def encode(message: dict[str, Any]) -> bytes:
    """A response or notification as one line."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def result_line(request_id: RequestId, result: object) -> bytes:
    return encode({"jsonrpc": "2.0", "id": request_id, "result": result})


def error_line(request_id: RequestId, error: Exception) -> bytes:
    """The answer to a request that failed with `error`."""
    if isinstance(error, ProtocolError):
        number, message = error.number, error.problem
        cause = error.__cause__ if isinstance(error.__cause__, ConfigError) else None
        data = error_data(cause or ConfigError("request", "", error.problem))
    elif isinstance(error, ArmctlError):
        number, message, data = ARMCTL_ERROR, str(error), error_data(error)
    else:
        number, message = INTERNAL_ERROR, f"the daemon failed on this request ({type(error).__name__}); see its log"
        data = error_data(RequestRefused("INTERNAL", message))
    return encode({"jsonrpc": "2.0", "id": request_id, "error": {"code": number, "message": message, "data": data}})


def notification_line(method: str, params: dict[str, Any]) -> bytes:
    return encode({"jsonrpc": "2.0", "method": method, "params": params})


_CODES = {ConfigError: "CONFIG", LogError: "LOG", NoDaemon: "NO_DAEMON", NoWayIn: "NO_DAEMON"}


def error_data(error: ArmctlError) -> dict[str, Any]:
    """An error as plain data: what a person or a script needs, and what a client needs to raise it again."""
    return {
        "code": error.code if isinstance(error, BusError | RequestRefused) else _CODES.get(type(error), "FAILED"),
        "reasons": list(error.reasons if isinstance(error, RequestRefused) else (str(error),)),
        "exit_status": error.exit_status,
        "type": type(error).__name__,
        "fields": {key: list(value) if isinstance(value, tuple) else value for key, value in vars(error).items()},
    }
