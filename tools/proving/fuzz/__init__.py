"""What the daemon and its files do with requests, configurations and names that are wrong in every way.

Judged:

1. Every line on the socket that wants an answer gets just one: a result, or an error that is declared. `INTERNAL`, a
   connection that ends and a daemon that dies are none of these.
2. Nothing hangs: what the arm's own motion does not hold up is answered within a second, and so is a client that asks
   for the status meanwhile. What lasts as long as a motion is answered once somebody says `stop`.
3. HTTP by schemathesis, against the application's own OpenAPI description: no undeclared status, type or body.
4. YAML is read or refused by `ConfigError` naming the file, recording names are kept or refused, within a second each,
   and nothing is touched outside the folder.
5. Memory is bounded: after a tenth of the requests it grows no more than `GROWTH_BOUND_MB`.

In-process, the daemon's own server, methods, host and control loop run on simulated servos and a virtual clock.
"""

import asyncio
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from proving.fuzz.daemon import in_process, on_socket
from proving.fuzz.files import recording_names, yaml_files
from proving.fuzz.http import http_requests
from proving.fuzz.tally import Tally

REQUESTS = 500_000
SOCKET_REQUESTS = 50_000
TEXTS = 100_000
# Of each HTTP operation, valid and invalid.
EXAMPLES = 150


def prove(
    seed: int,
    requests: int = REQUESTS,
    socket_requests: int = SOCKET_REQUESTS,
    texts: int = TEXTS,
    examples: int = EXAMPLES,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Try everything; one object of figures."""
    parts: dict[str, Callable[[Tally, Path], None]] = {
        "names": lambda tally, folder: recording_names(seed, texts, tally, folder),
        "yaml": lambda tally, folder: yaml_files(seed, texts, tally),
        "requests": lambda tally, folder: asyncio.run(in_process(seed, requests, tally, folder)),
        "socket": lambda tally, folder: on_socket(seed, socket_requests, tally, folder),
        "http": lambda tally, folder: http_requests(seed, examples, tally, folder),
    }
    tallies: dict[str, Tally] = {}
    for part, work in parts.items():
        with tempfile.TemporaryDirectory(prefix="armctl-") as name:
            tally = tallies[part] = Tally()
            begin_s = time.monotonic()
            work(tally, Path(name))
            tell(f"{part}: {tally.runs} in {time.monotonic() - begin_s:.0f} s, {tally.violations} violations")
            for example in tally.examples:
                tell(f"  {example}")
    return {
        "runs": sum(tally.runs for tally in tallies.values()),
        "violations": sum(tally.violations for tally in tallies.values()),
        **{part: tally.figures() for part, tally in tallies.items()},
        "examples": [f"{part}: {example}" for part, tally in tallies.items() for example in tally.examples],
        "seed": seed,
    }
