"""What runs until Ctrl-C: `armctl daemon`, `sim`, `web` and `live`; and the simulator's hand and faults."""

from __future__ import annotations

import os
import time
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.output import ARM, CONFIG, JSON, LINK, PORT, SOCKET, Output, Point, command, kept_option
from armctl.cli.parameters import parameters
from armctl.cli.tables import show_rows
from armctl.errors import ConfigError, NoDaemon
from armctl.files import load_arm, read_text, socket_path, tokens_path

if TYPE_CHECKING:
    from armctl.sim.control import SimulatorClient


DEFAULT_LINK = "armctl-servos"


def default_link() -> Path:
    """Where `armctl sim` publishes its port when nothing else is said."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / DEFAULT_LINK


@command("daemon", PORT, ARM, SOCKET, CONFIG)
def daemon_command(output: Output, log_dir: Path | None, wait: bool) -> int:
    """Control the arm, in the foreground, until Ctrl-C.

    Prints `ready SOCKET` once the servos answer. Ctrl-C brings a motion to rest and closes the log; torque stays as
    it is. This is no safety device: keep the power switch within reach.

    Example: armctl daemon --port /dev/ttyUSB0
    """
    import asyncio
    import logging

    from armctl.clock import ask_for_precedence
    from armctl.host.service_manager import wait_for_port

    when = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "  # the journal has a time of its own
    logging.basicConfig(level=logging.INFO, format=f"{when}%(levelname)s %(name)s: %(message)s")
    port = output.port or output.config.port
    if not port:
        raise ConfigError("armctl daemon", "--port", "no serial port named", "give --port PATH, or start `armctl sim`")
    arm, socket = output.arm, socket_path(output.socket)
    if wait:  # what is wrong in a file has been told by now, and nothing large is imported yet
        wait_for_port(port)
    from armctl.host.daemon import run_daemon

    def ready(path: str) -> None:
        ask_for_precedence()
        output.ready("socket", path)

    return asyncio.run(run_daemon(output.config, arm, port=port, socket=socket, log_dir=log_dir, ready=ready))


@command("sim")
def sim_command(
    output: Output,
    arm: str,
    link: Path | None,
    echo: bool,
    faults_file: Path | None,
    return_delay_us: int | None,
    factory: bool,
    spec_file: Path | None,
    **told: Any,
) -> int:
    """Simulate an arm: servos that answer the real protocol bytes on a pseudo terminal.

    Prints `ready PATH`; any program that drives AX-12A servos can open PATH. What can go wrong, and how FILE says so:
    armctl/docs/simulator.md and `armctl fault begin --help`.

    Example: armctl sim --link /tmp/servos
    """
    from armctl.dynamixel import ax12a
    from armctl.sim import pty
    from armctl.sim.arm import SimulatedArm
    from armctl.sim.faults import Fault, Faults, parse
    from armctl.sim.spec import DEFAULT_SPEC, put_together
    from armctl.sim.twin import load_twin

    played = load_arm(arm)
    faults: tuple[Fault, ...] = (Fault(kind="echo"),) if echo else ()
    if faults_file is not None:
        faults += parse(read_text(faults_file, "faults"), str(faults_file), played.servo_ids)
    twin = None if spec_file is None else load_twin(spec_file, played)
    spec, seed = put_together(DEFAULT_SPEC, told.pop("geometry"), told.pop("age"), twin), told["seed"]
    simulated = SimulatedArm(played, seed=seed, spec=spec, faults=Faults(faults, seed=seed))
    if return_delay_us is not None:
        simulated.set_all(ax12a.RETURN_DELAY, return_delay_us // 2)
    for limit in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT) if factory else ():
        simulated.set_all(limit, limit.default)
    pty.run(simulated, link=(link or default_link()).absolute(), ready=partial(output.ready, "port"), **told)
    return 0


@command("hand", LINK, SOCKET)
def hand_command(output: Output, from_m: Point, to_m: Point, seed: int, let_go: bool) -> None:
    """Let the simulator's hand guide the limp arm along a line, wobbling as hands do.

    Where no daemon answers, which would record that, it says so and guides the arm all the same.

    Example: armctl teach demo --takes 5 --yes & armctl hand --seed 1
    """
    with _simulator(output) as simulator:
        if let_go:
            simulator.let_go()
            output.result({"holding": False})
            return
        try:
            output.client(timeout_s=2.0).close()
        except NoDaemon as error:
            output.warn(f"warning: nobody records where the hand leads the arm: {error}")
        plan = simulator.guide(from_m, to_m, seed=seed)
        with output.progress("guiding the arm", plan.duration_s) as show:
            begin_s = time.monotonic()
            while (passed_s := time.monotonic() - begin_s) < plan.duration_s:
                show(passed_s)
                time.sleep(0.1)
        output.result(plan._asdict())


@click.group("fault")
def fault_command() -> None:
    """Let something go wrong with the simulated arm, now.

    Example: armctl fault begin mute --servo 3 --for 2
    """


class _ExplainedKinds(click.Command):
    """Lists the kinds of faults in its help; they are read when it is asked for."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from armctl.sim.faults import DESCRIPTIONS

        with formatter.section("Kinds"):
            formatter.write_dl(list(DESCRIPTIONS.items()))


@command("begin", LINK, group=fault_command, cls=_ExplainedKinds)
def fault_begin_command(output: Output, kind: str, **fault: Any) -> None:
    """Begin a fault; prints the number to end it by.

    Example: armctl fault begin late --servo 2 --value 12 --probability 0.1
    """
    with _simulator(output) as simulator:
        number = simulator.fault_begin(kind, **fault)
    output.answer({"id": number}, lambda: click.echo(number))


@command("end", LINK, group=fault_command)
def fault_end_command(output: Output, number: int) -> None:
    """End a fault by its number.

    Example: armctl fault end 1
    """
    with _simulator(output) as simulator:
        simulator.fault_end(number)
    output.result({"id": number})


@command("list", LINK, group=fault_command)
def fault_list_command(output: Output) -> None:
    """Show what goes wrong now, and what is planned.

    Example: armctl fault list
    """
    with _simulator(output) as simulator:
        faults = simulator.faults()
    output.answer({"faults": faults}, lambda: show_rows(output.console, "faults", "", faults))


def _simulator(output: Output) -> SimulatorClient:
    from armctl.sim.control import SimulatorClient, control_path

    return SimulatorClient(control_path((output.link or default_link()).absolute()))


WATCHED = kept_option("--arm arm_name", help="Calibration of the daemon's arm, if it is not the configured one.")


@command("live", WATCHED, SOCKET, CONFIG)
def live_command(output: Output, port: int, layout: Path | None) -> None:
    """Let Foxglove, Lichtblick or PlotJuggler watch the arm, until Ctrl-C.

    Prints `ready ws://127.0.0.1:PORT`; open that as a Foxglove WebSocket. Viewers can only look. Any program of this
    machine can connect, no other machine can. The log holds all that is shown here, and more.

    Example: armctl live --layout armctl.json; armctl live
    """
    from armctl.recording.disk import put
    from armctl.web import live

    if layout is not None:
        put(layout, files("armctl").joinpath("docs/foxglove-layout.json").read_text(), replacing=False)
        output.answer({"layout": str(layout)})
        return
    ready = partial(output.ready, "url")
    live.serve(output.socket, output.arm, port, lambda found: ready(f"ws://{live.HOST}:{found}"), output.warn)


@click.group("web", invoke_without_command=True)
@click.pass_context
def web_command(ctx: click.Context, port: int | None, lan: bool) -> None:
    """Serve the dashboard on this computer, until Ctrl-C.

    Prints `ready ADDRESS`; the address holds the token that opens the page. Nobody else can reach it: for another
    computer use --lan, or a tunnel, `ssh -L 8080:127.0.0.1:8080 HOST`, and open the printed address there.
    `armctl web token add NAME` gives a person a token of their own.

    Example: armctl web
    """
    if ctx.invoked_subcommand is None:
        from armctl.web.server import serve

        output = ctx.ensure_object(Output)
        page = partial(serve, ready=partial(output.ready, "address"), config_file=output.config_file, lan=lan)
        page(output.config, socket=socket_path(output.socket), port=port or (8443 if lan else 8080))


web_command.params += [*parameters("processes", "web"), SOCKET, CONFIG, JSON]


@web_command.group("token")
def web_token() -> None:
    """Tokens of people who open the dashboard's page.

    Example: armctl web token add ada
    """


@command("add", CONFIG, group=web_token)
def web_token_add(output: Output, name: str, role: Any) -> None:
    """Give a person a token of their own; it is printed once, and kept as a hash.

    Example: armctl web token add ada --role look
    """
    from armctl.web.tokens import add

    person, token = add(tokens_path(output.config_file), name, role)
    output.answer({"tokens": [{**person.listed(), "token": token}]})


@command("list", CONFIG, group=web_token)
def web_token_list(output: Output) -> None:
    """Who has a token, and for what.

    Example: armctl web token list
    """
    from armctl.web.tokens import people

    found = [one.listed() for one in people(tokens_path(output.config_file))]
    rows = "\n".join(f"{one['name']:<20} {one['role']:<8} {one['created']}" for one in found)
    output.answer({"tokens": found}, rows or "nobody has a token; `armctl web token add NAME`")


@command("revoke", CONFIG, group=web_token)
def web_token_revoke(output: Output, name: str) -> None:
    """Take a person's token away; from now on it opens nothing.

    Example: armctl web token revoke ada
    """
    from armctl.web.tokens import revoke

    output.answer({"tokens": [revoke(tokens_path(output.config_file), name).listed()]}, f"{name} has no token any more")
