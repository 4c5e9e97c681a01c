"""`armctl identify`: what the arm's servos are like, and its twin for the simulator."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.output import CONFIG, HOLDS, SOCKET, Output, command
from armctl.cli.tables import below, show_rows
from armctl.errors import ConfigError
from armctl.files import find_arm_file, load_arm, read_text

if TYPE_CHECKING:
    from armctl.config import ArmConfig
    from armctl.trajectory.identification import Trace


@command("identify", SOCKET, CONFIG)
def identify_command(
    output: Output,
    joints: str | None,
    quick: bool,
    report: Path | None,
    logs: tuple[Path, ...],
    more: tuple[str, ...],
    compare: Path | None,
) -> None:
    """Find friction, slope, play and delay of each joint: the daemon moves one after the other, about five minutes.

    The arm stands up, leans by some degrees and sweeps by 16 deg to either side, one joint at a time, and is back where
    it was at the end. Pre-flight looks at every motion before it begins. Keep clear; Ctrl-C stops it. --quick only
    finds out how servos begin their speed ramps, by a few degrees where the arm stands. --from-logs moves nothing.

    What was not seen is said. The spec that comes of it is the twin of this arm: `armctl sim --spec FILE`. How ramps
    begin is written into the arm's file. --compare moves nothing: the twin plays what a log had the arm do, and you
    see how well it foretells that.

    Example: armctl torque on; armctl identify --report servos.html
    """
    from armctl.kinematics import robots
    from armctl.lab import identification as lab
    from armctl.report import identified
    from armctl.trajectory.identification import QUANTITIES, Trace, identify

    if compare is not None:
        if joints or quick or logs or more:
            raise click.UsageError("--compare takes one log, and no other option but --report")
        _compare(output, compare, report)
        return
    if more and not logs and joints is None:
        raise ConfigError("armctl identify", more[0], "belongs to no option", "name it behind --from-logs or --joints")
    if logs:
        logs += tuple(map(Path, more))
        told = [lab.read(path) for path in logs]
        arm, traces = told[0][0], [trace for _, trace in told]
        own = (arm if quick else load_arm(output.config.arm)).arm_id
        if others := [path for path, (other, _) in zip(logs, told, strict=True) if other.arm_id != own]:
            remedy = "leave it out, or name a configuration of that arm by --config"
            raise ConfigError("armctl identify", "--from-logs", f"{others[0]} is of another arm than {own}", remedy)
    else:
        arm, traces = _moved(output, joints and ",".join((joints, *more)), quick=quick)
    found = identify(arm, robots.of(arm).chain, Trace.joined(traces))
    result: dict[str, Any] = {"joints": lab.told(found), "ramp_from_reference": found.ramp_from_reference, "spec": None}
    if quick:
        result["joints"] = []
    elif any(joint.values.keys() & QUANTITIES for joint in found.joints):
        result["spec"] = str(lab.save(output.config, arm, found))
    result["path"] = None if logs else _kept(output, arm, found.ramp_from_reference)
    if report is not None:
        identified.write(found, report)
    output.answer(result, lambda: _show(output, result))


def _moved(output: Output, joints: str | None, *, quick: bool) -> tuple[ArmConfig, list[Trace]]:
    """The daemon's arm, and what its servos said while it moved."""
    from armctl.lab import identification as lab

    output.follow_daemon()
    arm = output.arm
    names = arm.joint_names if joints is None else joints.split(",")
    if unknown := set(names) - set(arm.joint_names):
        known = f"name some of {','.join(arm.joint_names)}"
        raise ConfigError("armctl identify", "--joints", f"no joint {sorted(unknown)[0]}", known)
    output.after_interrupt = f"{HOLDS}; recordings of the motions so far are kept"
    output.warn("the arm moves now, one joint after the other; keep clear")
    with output.client() as client, output.progress("small motions; Ctrl-C stops", 1.0) as show:
        return arm, lab.moved(client, arm, [arm.joint_names.index(name) for name in names], show, quick=quick)


def _kept(output: Output, arm: ArmConfig, ramp: bool | None) -> str | None:
    """Have the arm's file hold how its servos' ramps begin, once that was seen; where it was written, if it was."""
    from armctl.commissioning import arm_file
    from armctl.commissioning.calibration import calibration_text

    if ramp is None or ramp == arm.ramp_from_reference:
        return None
    lines = read_text(find_arm_file(output.config.arm), "calibration").split("\n")
    remarks = [line.removeprefix("#").strip() for line in takewhile(lambda line: line.startswith("#"), lines)]
    text = calibration_text(arm.model_copy(update={"ramp_from_reference": ramp}), remarks)
    try:
        arm_file.renew(path := arm_file.active_path(output.config.arm), text)
    except ConfigError as error:
        output.warn(f"ramp_from_reference is not kept: {error}")
        return None
    return str(path)


def _compare(output: Output, log: Path, report: Path | None) -> None:
    """Show how well the twin foretells a log."""
    from armctl.cli.logs import loaded
    from armctl.lab import identification as lab
    from armctl.report import identified

    timeline, spec = loaded(output, log), lab.twin_path(output.config)
    if not spec.exists():
        raise ConfigError(str(spec), "", "there is no twin of this arm yet", "identify it first: armctl identify")
    with output.progress("the twin plays the log", 1.0) as show:
        found = lab.compared(timeline, spec, show)
    if report is not None:
        identified.write_compared(found, report)
    tool_mm = 1e3 * found.tool_m
    figures = {"tool_mean_mm": float(tool_mm.mean()), "tool_max_mm": float(tool_mm.max())}
    rows = found.rows()
    if not output.result({"compared": rows, **figures, "spec": str(spec)}):
        show_rows(output.console, "compared", "The twin beside the log", rows)
        output.say(below("compared", figures))


def _show(output: Output, result: dict[str, Any]) -> None:
    if result["joints"]:
        show_rows(output.console, "identified", "Each with its standard deviation", result["joints"])
    for row in result["joints"]:
        for key, why in row["unseen"].items():
            output.say(f"{row['name']}: {key} was not seen: {why}")
    ramp = {True: "go on from where they are", False: "begin at the shaft", None: "were not seen"}
    output.say(f"with a new goal the speed ramps {ramp[result['ramp_from_reference']]} (ramp_from_reference)")
    if result["path"]:
        output.say(f"written: {result['path']}; restart the daemon, which has read the one before")
    if spec := result["spec"]:
        output.say(f"{spec}: the twin of this arm; armctl sim --spec, armctl experiment line --virtual --spec")
