"""`armctl daemon`, `armctl sim` and the simulator's hand."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path

import click

from armctl.cli.output import POINT, Output, config_option, output_option, socket_option
from armctl.errors import ConfigError

DEFAULT_LINK = "armctl-servos"


def default_link() -> Path:
    """Where `armctl sim` publishes its port when nothing else is said."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / DEFAULT_LINK


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

    from armctl.config import load_arm, load_config, socket_path
    from armctl.daemon import serve

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
@click.option("--lockstep", is_flag=True, help="The arm's time advances with the bus master's ticks, not the clock's.")
@output_option
def sim_command(
    output: Output,
    arm: str,
    link: Path | None,
    seed: int,
    return_delay_us: int | None,
    latency_ms: float,
    lockstep: bool,
) -> int:
    """Play an arm: simulated servos that answer real protocol bytes on a pseudo terminal.

    Prints `ready PATH`; any program that drives AX-12A servos can open PATH.

    Example: armctl sim --link /tmp/servos
    """
    from armctl.config import load_arm
    from armctl.sim import pty

    def ready(path: str) -> None:
        if not output.result({"port": path}):
            click.echo(f"ready {path}")

    pty.run(
        load_arm(arm),
        link=(link or default_link()).absolute(),
        seed=seed,
        latency_ms=latency_ms,
        return_delay_us=return_delay_us,
        lockstep=lockstep,
        ready=ready,
    )
    return 0


@click.command("hand")
@click.option("--link", type=click.Path(path_type=Path), help="The simulator's port, as it printed it.")
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
    from armctl.sim.control import SimulatorClient, control_path

    port = (link or default_link()).absolute()
    with SimulatorClient(control_path(port)) as simulator:
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
