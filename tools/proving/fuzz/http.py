"""Requests to the dashboard: by its OpenAPI description, and beyond what one can describe."""

import http.client
import json
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from armctl.errors import ArmctlError
from armctl.web.guard import TOKEN_HEADER
from proving.dashboard import Dashboard, dashboard
from proving.fuzz import malformed
from proving.fuzz.files import TAKES, Takes
from proving.fuzz.tally import HANG_S, Memory, Tally

# Where the answer waits for the arm, or for a job.
LASTING = (
    "/api/optimize",
    "/api/park",
    "/api/torque-on",
    "/api/teach/",
    "/api/take/",
    "/api/stop",
    "/api/clear",
    "/api/release",
)
PATIENCE_S = 30.0
TRIES = 3
T = TypeVar("T")
LINE: dict[str, Any] = {"from_m": [0.18, -0.1, 0.1], "to_m": [0.18, 0.1, 0.1]}
POSTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("/api/stop", {}),
    ("/api/release", {"confirm": True}),
    ("/api/teach/begin", {"confirm": True}),
    ("/api/take/begin", {"name": "take"}),
    ("/api/optimize", {**LINE, "name": "x", "recordings": ["none"], "via": [0], "seed": 1, "settings": {"elite": 2}}),
    ("/api/plans/none/run", {}),
)
GETS = ("/api/recordings/{}", "/api/plans/{}", "/api/logs/{}", "/api/logs/{}/file", "/api/logs/{}?from_s={}&to_s={}")


def http_requests(seed: int, examples: int, tally: Tally, folder: Path) -> None:
    """So many valid and as many invalid requests of each operation, then malformed ones and WebSockets."""
    with dashboard(folder, seed) as running:
        Takes(folder / "template", folder / "recordings")
        memory = Memory(running.web.pid)
        if warm := examples // 10:
            _by_description(seed, warm, running, tally)
            memory.mark()
        _by_description(seed + 1, examples, running, tally)
        _malformed(seed, 20 * examples, running, tally)
        _websockets(seed, examples, running, tally)
        if running.web.poll() is not None:
            tally.violation(f"the web process ended with status {running.web.returncode}")
        else:
            memory.judge(tally)
    log = running.web_log.read_text(encoding="utf-8", errors="replace")
    if "Traceback" in log:
        tally.violation(log[-500:])


def _by_description(seed: int, examples: int, running: Dashboard, tally: Tally) -> None:
    """What schemathesis makes of /api/openapi.json, valid and invalid."""
    try:
        import hypothesis
        import schemathesis
        from hypothesis import HealthCheck, Phase
        from schemathesis.checks import not_a_server_error
        from schemathesis.generation import GenerationMode
        from schemathesis.specs.openapi import checks
    except ImportError as error:
        raise ArmctlError(f"the fuzz proof needs {error.name}; install it with: pip install 'armctl[test]'") from None

    headers = {TOKEN_HEADER: running.token}
    schema = schemathesis.openapi.from_url(f"{running.address}/api/openapi.json", headers=headers)
    wanted = [
        not_a_server_error,
        checks.status_code_conformance,
        checks.content_type_conformance,
        checks.response_schema_conformance,
    ]

    def attempt(case: Any) -> None:
        def send() -> Any:
            return case.call(base_url=running.address, headers=headers, timeout=PATIENCE_S)

        what = f"{case.method} {case.formatted_path} {case.query} {case.body!r}"
        response = _timed(send, case.formatted_path, what, tally)
        tally.runs += 1
        tally.outcomes[str(response.status_code)] += 1
        # 503 is declared: a daemon that is gone is told.  Here it is not gone.
        if response.status_code == 503:
            tally.violation(f"503 of {what}")
        try:
            case.validate_response(response, checks=wanted)
        except Exception as error:
            problems = getattr(error, "exceptions", [error])
            tally.violation(f"{what}: {response.status_code}, {'; '.join(str(problem) for problem in problems)}")

    for found in schema.get_all_operations():
        operation: Any = found.ok()  # type: ignore[union-attr]  # a description that is wrong itself ends here
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
            settings = hypothesis.settings(
                max_examples=examples,
                deadline=None,
                database=None,
                phases=(Phase.generate,),
                suppress_health_check=list(HealthCheck),
            )
            try:
                strategy = operation.as_strategy(generation_mode=mode)
                test: Any = settings(hypothesis.given(strategy)(attempt))  # type: ignore[no-untyped-call]
                hypothesis.seed(seed)(test)()
            except (hypothesis.errors.Unsatisfiable, schemathesis.errors.SchemathesisError) as error:
                # An operation without parameters has no invalid ones.
                tally.outcomes[f"no {mode.value} requests: {type(error).__name__}"] += 1


def _malformed(seed: int, count: int, running: Dashboard, tally: Tally) -> None:
    """Bodies, names and headers that no description tells of."""
    rng = random.Random(seed)
    for _ in range(count):
        method, path, body = "GET", rng.choice(GETS), b""
        headers = {TOKEN_HEADER: running.token}
        if rng.random() < 0.6:
            method = "POST"
            path, valid = rng.choice(POSTS)
            tree: Any = valid
            for _ in range(rng.choice((1, 1, 2, 3))):
                tree = malformed.changed(rng, tree)
            body = malformed.json_text(tree, ascii_only=rng.random() < 0.7).encode("utf-8", "surrogatepass")
            if rng.random() < 0.2:
                body = malformed.damaged(rng, body)
            if rng.random() < 0.02:
                body = malformed.flood(rng)
            headers["Content-Type"] = rng.choice(("application/json",) * 9 + ("text/plain",))
        else:
            name = rng.choice(TAKES) if rng.random() < 0.2 else malformed.name(rng)
            quoted = quote(name.encode("utf-8", "surrogatepass"), safe=rng.choice(("", "/")))
            odd = quote(malformed.json_text(malformed.odd(rng)).encode("utf-8", "surrogatepass")[:200])
            path = path.format(quoted, odd, odd)
            method = rng.choice(("GET", "GET", "GET", "DELETE", "PUT", "HEAD"))
        if rng.random() < 0.1:
            word = rng.choice(malformed.TEXTS).encode("ascii", "ignore").decode().strip("\n\0\x1b")
            headers[rng.choice((TOKEN_HEADER, "Host", "Origin", "Sec-Fetch-Site", "Content-Type"))] = word[:80]
        _ask(running, method, path, body, headers, tally)


def _ask(running: Dashboard, method: str, path: str, body: bytes, headers: dict[str, str], tally: Tally) -> None:
    what = f"{method} {path[:120]} {body[:200]!r} {headers}"

    def send() -> tuple[http.client.HTTPResponse, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", running.port, timeout=PATIENCE_S)
        try:
            connection.request(method, path, body or None, headers)
            answer = connection.getresponse()
            return answer, answer.read()
        finally:
            connection.close()

    try:
        answer, told = _timed(send, path, what, tally)
    except (OSError, http.client.HTTPException, ValueError) as error:
        tally.violation(f"{type(error).__name__}: {error} after {what}")
        return
    tally.runs += 1
    tally.outcomes[str(answer.status)] += 1
    if answer.status >= 500:
        tally.violation(f"{answer.status} {told[:200]!r} of {what}")
    if answer.status >= 400 and method != "HEAD" and answer.getheader("content-type") == "application/json":
        json.loads(told)


def _timed(send: Callable[[], T], path: str, what: str, tally: Tally) -> T:
    """The answer; slow ones are asked for again, because what a busy machine holds up once is fast the next time."""
    for _ in range(TRIES):
        begin_s = time.monotonic()
        answer = send()
        seconds = time.monotonic() - begin_s
        if seconds <= HANG_S or path.startswith(LASTING):
            break
        tally.outcomes["slow"] += 1
    else:
        tally.violation(f"{seconds:.2f} s, and so {TRIES} times, for {what}")
    if not path.startswith(LASTING):
        tally.slowest_s = max(tally.slowest_s, seconds)
    return answer


def _websockets(seed: int, count: int, running: Dashboard, tally: Tally) -> None:
    """First messages that hold no token end the connection, whatever they are."""
    from websockets.exceptions import ConnectionClosed, InvalidHandshake
    from websockets.sync.client import connect
    from websockets.typing import Origin

    rng = random.Random(seed)
    for _ in range(count):
        tree = malformed.changed(rng, {"token": running.token[:-1] + "!"})
        text = malformed.json_text(tree)
        said: str | bytes = text
        if rng.random() < 0.1:
            said = malformed.damaged(rng, text.encode())
        try:
            with connect(
                f"ws://127.0.0.1:{running.port}/api/stream", origin=Origin(running.address), compression=None
            ) as socket:
                socket.send(said)
                socket.recv(timeout=HANG_S)
                tally.violation(f"a WebSocket was served after {said[:200]!r}")
        except ConnectionClosed as closed:
            tally.runs += 1
            code = None if closed.rcvd is None else closed.rcvd.code
            tally.outcomes[f"websocket {code}"] += 1
            if code not in (1003, 1007, 1008, 1009):
                tally.violation(f"a WebSocket ended with {code} after {said[:200]!r}")
        except (TimeoutError, InvalidHandshake, OSError) as error:
            tally.violation(f"{type(error).__name__}: {error} after {said[:200]!r}")
