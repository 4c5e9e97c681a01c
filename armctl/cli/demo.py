"""Everything without an arm, by one command: `armctl demo` and `armctl try`."""

import os
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from armctl.cli.keys import keys
from armctl.cli.output import SOCKET, Output, command
from armctl.cli.tables import below, show_rows
from armctl.files import socket_path


@command("demo")
def demo_command(output: Output, out: Path, seed: int, arm: str) -> int:
    """The whole job on simulated servos, in three to four minutes.

    A simulated hand teaches five candidates, the genetic algorithm straightens them, the daemon runs the result through
    0, 1 and 2 intermediate points: plain, then corrected by what these runs showed of the arm, then refined by two
    further runs. Every log is replayed bit for bit, and a report is written.

    Another arm goes along the first line that it reaches.

    Example: armctl demo --arm crane-plus-v2 --out demo
    """
    from armctl.lab import demo

    with _ending_all():
        result = demo.run(out.absolute(), seed, output.progress, arm)
    output.answer(result, lambda: show(output, result))
    return 0 if result["replay"]["mismatches"] == 0 else 1


@command("try", SOCKET)
def try_command(output: Output, arm: str, port: int, no_browser: bool) -> int:
    """An arm to play with, without one: simulated servos, the daemon and the dashboard, until Ctrl-C.

    Prints `ready ADDRESS` and opens it in the browser. There, begin to teach; any key that you press here has a
    simulated hand guide the limp arm along a line. Straighten what was taught, and run it. In another terminal every
    command works on this arm: `armctl status`, `armctl move`, `armctl stop`. What is recorded stays in ./armctl-try.

    Example: armctl try --arm crane-plus-v2
    """
    import webbrowser

    from armctl.cli.processes import default_link
    from armctl.lab.trial import trial

    socket, link, folder = socket_path(output.socket), default_link().absolute(), Path("armctl-try").absolute()
    with _ending_all(), trial(folder, arm, socket, link, port, output.progress) as running:
        ends = [",".join(f"{x:.3f}" for x in end) for end in running.line or ()]
        address = "&".join([f"{running.address}&view=guide", *map("{}={}".format, ("from", "to"), ends)])
        output.ready("url", address)
        if not no_browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(address)
        output.say(
            "The page leads you: show a line by hand, straighten it, run it. The hand is the simulator's: press a\n"
            f"button there, or a key here. Its line: {' to '.join(ends) or 'none is in reach'}"
        )
        try:
            with keys(sys.stdin) as pressed:
                running.serve(lambda: pressed.wait(0.0), output.say)
        except KeyboardInterrupt:
            output.say("ended; what was recorded is in armctl-try")
    return 0


@contextmanager
def _ending_all() -> Iterator[None]:
    """Told to end, or its terminal closed, this program ends the others first, which have sessions of their own."""
    from armctl.host.service_manager import endings

    def leave(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    with ExitStack() as cleanup:
        for number in set(endings()) - {signal.SIGINT}:
            cleanup.callback(signal.signal, number, signal.signal(number, leave))
        yield


def show(output: Output, result: dict[str, Any]) -> None:
    from armctl.report.line import PRINTED

    rows = [{**row, "paper": PRINTED[row["via"]]} for row in result["rows"]]
    told = result | {"best_take_mm": min(take["mean_error_mm"] for take in result["baseline"])}
    told["ours"] = _seconds(row["duration_s"] for row in rows)
    told["papers"] = _seconds(row["paper"].duration_s for row in rows)
    told["report"] = min(result["report"], os.path.relpath(result["report"]), key=len)
    show_rows(output.console, "demo", "Distance of the tool from the line, mean / maximum, mm", rows)
    output.say(below("demo", told))


def _seconds(durations_s: Iterable[float]) -> str:
    """Each duration once, in order."""
    return ", ".join(dict.fromkeys(f"{duration_s:.1f}" for duration_s in durations_s)) + " s"
