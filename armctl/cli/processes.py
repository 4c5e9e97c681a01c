"""`armctl daemon`, `armctl sim`, and the simulator's hand and faults."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armctl.cli.output import POINT, F, Output, config_option, output_option, socket_option
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.sim.control import SimulatorClient

DEFAULT_LINK = "armctl-servos"


def default_link() -> Path:
    """Where `armctl sim` publishes its port when nothing else is said."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / DEFAULT_LINK


def simulator_option(function: F) -> F:
    """Adds `--link`."""
    text = "The simulator's port, as it printed it."
    return click.option("--link", type=click.Path(path_type=Path), help=text)(function)


@click.command("daemon")
@click.option("--port", metavar="PATH", help="Serial port of the arm, or the link of `armctl sim`.")
@click.option("--arm", metavar="NAME|FILE", help="Which calibration file describes the arm.")
@click.option("--log-dir", type=click.Path(file_okay=False, path_type=Path), help="Folder of the MCAP logs.")
@socket_option
@config_option
@output_option
def daemon_command(
    output: Output, port: str | None, arm: str | None, log_dir: Path | None, socket: str | None, config_file: str | None
) -> int:
    """Own the arm in the foreground until Ctrl-C.

    Prints `ready SOCKET` once the servos answer. Ctrl-C brings a motion to rest and closes the log; torque stays as
    it is. This is no safety device: keep the power switch within reach.

    Example: armctl daemon --port /dev/ttyUSB0
    """
    import logging

    from armctl.files import load_arm, load_config, socket_path
    from armctl.host.daemon import serve

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    config = load_config(config_file)
    chosen = port or config.port
    if not chosen:
        raise ConfigError("armctl daemon", "--port", "no serial port named", "give --port PATH, or start `armctl sim`")

    def ready(path: str) -> None:
        if not output.result({"socket": path}):
            click.echo(f"ready {path}")

    return serve(
        config, load_arm(arm or config.arm), port=chosen, socket=socket_path(socket), log_dir=log_dir, ready=ready
    )


@click.command("sim")
@click.option("--arm", default="ax12-line", show_default=True, metavar="NAME|FILE", help="Which arm to play.")
@click.option("--link", type=click.Path(path_type=Path), help="Stable name of the port.")
@click.option("--seed", default=0, show_default=True, help="Draws masses, friction, play, offsets and noise.")
@click.option("--return-delay-us", type=click.IntRange(0, 508), help="Return delay of every servo.")
@click.option("--latency-ms", type=click.FloatRange(0.0, 100.0), default=0.0, help="Latency timer of the adapter.")
@click.option("--echo", is_flag=True, help="The adapter hears what the host says.")
@click.option(
    "--faults", "faults_file", type=click.Path(path_type=Path), metavar="FILE", help="What goes wrong and when (YAML)."
)
@click.option("--lockstep", is_flag=True, help="The arm's time advances with the bus master's ticks, not the clock's.")
@output_option
def sim_command(
    output: Output,
    arm: str,
    link: Path | None,
    seed: int,
    return_delay_us: int | None,
    latency_ms: float,
    echo: bool,
    faults_file: Path | None,
    lockstep: bool,
) -> int:
    """Play an arm: simulated servos that answer real protocol bytes on a pseudo terminal.

    Prints `ready PATH`; any program that drives AX-12A servos can open PATH. What can go wrong, and how FILE says so:
    armctl/docs/simulator.md and `armctl fault begin --help`.

    Example: armctl sim --link /tmp/servos
    """
    from armctl.files import load_arm, read_text
    from armctl.sim import pty
    from armctl.sim.faults import Fault, parse

    played = load_arm(arm)
    faults: tuple[Fault, ...] = (Fault(kind="echo"),) if echo else ()
    if faults_file is not None:
        faults += parse(read_text(faults_file, "faults"), str(faults_file), played.servo_ids)

    def ready(path: str) -> None:
        if not output.result({"port": path}):
            click.echo(f"ready {path}")

    pty.run(
        played,
        link=(link or default_link()).absolute(),
        seed=seed,
        latency_ms=latency_ms,
        return_delay_us=return_delay_us,
        lockstep=lockstep,
        faults=faults,
        ready=ready,
    )
    return 0


@click.command("hand")
@simulator_option
@click.option("--from", "from_m", type=POINT, default="0.18,-0.125,0.10", show_default=True, help="Start, metres.")
@click.option("--to", "to_m", type=POINT, default="0.18,0.125,0.10", show_default=True, help="End, metres.")
@click.option("--seed", default=0, show_default=True, help="A different wobble for each number.")
@click.option("--let-go", is_flag=True, help="Only let go of the arm.")
@output_option
def hand_command(
    output: Output,
    link: Path | None,
    from_m: tuple[float, float, float],
    to_m: tuple[float, float, float],
    seed: int,
    let_go: bool,
) -> None:
    """Let the simulator's hand guide the limp arm along a line, wobbling as hands do.

    Example: armctl teach demo --takes 5 & armctl hand --seed 1
    """
    with _simulator(link) as simulator:
        if let_go:
            simulator.let_go()
            output.result({"holding": False})
            return
        plan = simulator.guide(from_m, to_m, seed=seed)
        duration_s = plan.duration_s
        with output.progress("guiding the arm", duration_s) as show:
            begin_s = time.monotonic()
            while (passed_s := time.monotonic() - begin_s) < duration_s:
                show(passed_s, "")
                time.sleep(0.1)
        output.result(asdict(plan))


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


@fault_command.command("begin", cls=_ExplainedKinds)
@click.argument("kind")
@click.option("--servo", "servo_id", type=int, help="Which servo; every one when left out.")
@click.option("--probability", default=1.0, show_default=True, help="On each occasion.")
@click.option("--count", type=int, help="At most so many times.")
@click.option("--for", "duration_s", type=float, metavar="SECONDS", help="Until it is ended when left out.")
@click.option("--value", type=float, help="What it means depends on the kind.")
@simulator_option
@output_option
def fault_begin_command(
    output: Output,
    kind: str,
    servo_id: int | None,
    probability: float,
    count: int | None,
    duration_s: float | None,
    value: float | None,
    link: Path | None,
) -> None:
    """Begin a fault; prints the number to end it by.

    Example: armctl fault begin late --servo 2 --value 12 --probability 0.1
    """
    with _simulator(link) as simulator:
        number = simulator.fault_begin(
            kind, servo_id=servo_id, probability=probability, count=count, duration_s=duration_s, value=value
        )
    if not output.result({"id": number}):
        click.echo(number)


@fault_command.command("end")
@click.argument("number", type=int)
@simulator_option
@output_option
def fault_end_command(output: Output, number: int, link: Path | None) -> None:
    """End a fault by its number.

    Example: armctl fault end 1
    """
    with _simulator(link) as simulator:
        simulator.fault_end(number)
    output.result({"id": number})


@fault_command.command("list")
@simulator_option
@output_option
def fault_list_command(output: Output, link: Path | None) -> None:
    """Show what goes wrong now, and what is planned.

    Example: armctl fault list
    """
    with _simulator(link) as simulator:
        faults = simulator.faults()
    if output.result({"faults": faults}):
        return
    for fault in faults:
        until = "until ended" if fault["end_s"] is None else f"to {fault['end_s']:.1f} s"
        servo = "" if fault["servo_id"] is None else f" servo {fault['servo_id']}"
        state = "now" if fault["active"] else "planned"
        click.echo(f"{fault['id']:3d} {fault['kind']}{servo}: {state}, from {fault['begin_s']:.1f} s {until}")


def _simulator(link: Path | None) -> SimulatorClient:
    from armctl.sim.control import SimulatorClient, control_path

    return SimulatorClient(control_path((link or default_link()).absolute()))
