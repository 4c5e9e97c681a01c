"""`armctl calibrate`: zeros and lengths from touched points, and how the arm sags.

The points are touched with a limp arm, without the daemon; `--holding` and `--sag` ask a running daemon to move it.
"""

from __future__ import annotations

from contextlib import ExitStack
from datetime import date, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.motion import by_keys
from armctl.cli.output import ARM, BAUD, CONFIG, PORT, SOCKET, Output, command, millimetres
from armctl.cli.setup import AtTerminal, opened
from armctl.cli.tables import below, show_rows
from armctl.errors import RequestRefused

if TYPE_CHECKING:
    from armctl.client import Client
    from armctl.commissioning.calibration import Readings
    from armctl.commissioning.holding import Way
    from armctl.config import ArmConfig

# How high above a point the arm is moved before it is led, and how fast at first.
ABOVE_M, LED_M_S = 0.03, 0.01
# How many ticks it is looked at where it stands.
LOOKS = 20
ASKED = ("armctl calibrate", "or give --readings FILE")
# Keys at each point, and what they are for.
KEYS = "s: skip this point; b: take the last touch back"


@command("calibrate", ARM, PORT, BAUD, CONFIG, SOCKET)
def calibrate_command(output: Output, points: Path | None, touches: int, way: tuple[str, ...], **asked: Any) -> None:
    """Find zero ticks and link lengths: touch known points with the limp arm's tool tip.

    Fix a sheet with known points to the table, its x axis ahead of the base, and touch every point in different
    postures: elbow high and low, tool steep and flat. A value that the points do not show is left alone, and named.
    Torque stays off and nothing is written to the servos. The result is the arm's file from then on; the one before
    stays in NAME.history beside it, as 1.yaml and so on, and --undo takes it back. An arm that comes with armctl gets a
    file of your own.

    With --holding the arm stands by itself, as it does at work: the daemon moves it above each point, you lead the tip
    near it by keys and press it onto it with a finger. Twists of its axes, waves of its sensors and what its weight
    bends are found as well. Each point is left out of the fit in turn: that shows how good the result is. An arm that
    would be no better stays as it was. The point and the posture that tell most come next, so you may stop early.
    --sheet draws the points to be printed, or points that are in the arm's reach.

    --sag: a running daemon moves the arm along eight lines. What gravity and friction do to each joint is kept beside
    the calibration, as NAME.sag.json. --pairs, for joints that two servos turn: both are read while you lead the limp
    joint through its range.

    Example: armctl calibrate --points sheet.csv
    """
    from armctl.commissioning import arm_file, calibration, pairs
    from armctl.commissioning import holding as under_torque

    if (sheet := asked.pop("sheet")) is not None:
        _draw_sheet(output, sheet, points, *way, *asked.values())
        return
    readings, zero_at, out, save_readings = (asked[key] for key in ("readings", "zero_at", "out", "save_readings"))
    _refuse_several((points, readings, zero_at), way, (out, save_readings))
    holding = way == ("holding",)
    if way in (("sag",), ("undo",)):
        (_calibrate_sag if way == ("sag",) else _undo)(output)
        return
    if holding and points is not None:
        output.follow_daemon()
    before = output.arm
    name = output.arm_name or output.config.arm
    path = out or arm_file.active_path(name)
    arm_file.refuse_taken(out, save_readings)
    more, table = dict[str, Any](), "holding" if holding else "limp"
    if way == ("pairs",):
        after = pairs.measured(before, partial(opened, output), AtTerminal(output, *ASKED))
        remark = "what the two servos of a joint read at the same places"
    elif zero_at is not None:
        after = _zeroed(output, before, zero_at)
        remark = f"zero ticks read in the {zero_at} pose"
    else:
        if points is not None:
            usual = save_readings or path.with_name(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}.readings")
            session = _touch_all(output, before, points, touches, usual, holding)
        else:
            session = calibration.load_readings(readings or Path(), before)
        if save_readings is not None:
            arm_file.write(save_readings, calibration.readings_text(session))
        more = (under_torque if holding else calibration).fit(before, session.touches)._asdict()
        after = more.pop("arm")
        remark = f"{len(session.touches)} touches, {below(table, more)}"
    text = calibration.calibration_text(after, [f"Calibrated {date.today().isoformat()} from {name}: {remark}."])
    kept = arm_file.renew(path, text)
    result = {"path": str(path), "changes": _changes(before, after)} | more
    if output.result(result):
        return
    if more:
        show_found(output, table, more)
    _show_changes(output, result, kept, str(name if out is None else out))


def _refuse_several(sources: tuple[Any, ...], way: tuple[str, ...], new: tuple[Path | None, ...]) -> None:
    """Refuse anything but one kind of calibration; points may be touched by an arm that holds itself."""
    holding = way == ("holding",)
    if sum(map(bool, (*sources, *(() if holding else way)))) != 1 or (holding and sources[2]):
        kinds = "--points FILE, --readings FILE (either with --holding), --zero-at rest|zero, --sag, --pairs and --undo"
        raise click.UsageError(f"give one of {kinds}")
    if way in (("sag",), ("undo",)) and any(new):
        raise click.UsageError(f"--{way[0]} writes no file of another name; leave out --out and --save-readings")


def _draw_sheet(output: Output, file: Path, points: Path | None, *others: Any) -> None:
    """Draw points to be printed; without any, some that are in reach, whose file then lies beside the drawing."""
    from armctl.commissioning import arm_file, calibration, holding
    from armctl.report import sheet

    if any(others):
        raise click.UsageError("--sheet draws a sheet; give nothing else but --points")
    if file.suffix != ".svg":
        raise click.UsageError(f"--sheet draws SVG; give a name that ends in .svg, not {str(file)!r}")
    arm = output.arm
    places = calibration.read_points(points) if points else holding.sheet_points(arm, ABOVE_M)
    calibration.check_points(arm, places * 20)  # as often as each may be touched
    if points is None:
        arm_file.refuse_taken(points := file.with_suffix(".csv"))
        arm_file.write(points, "".join("{:.4f},{:.4f},{:.4f}\n".format(*place) for place in places))
    paper = sheet.write(places, arm.arm_id, arm.floor_m, file)
    result = {"sheet": str(file), "paper": paper, "points": str(points)}
    output.answer(result, f"{file}: {len(places)} points on {paper}; print it at 100 %\npoints: {points}")


def _undo(output: Output) -> None:
    """Have the arm's file hold what it held before it was renewed last."""
    from armctl.commissioning import arm_file
    from armctl.config import ArmConfig, parse_yaml, validate

    name = output.arm_name or output.config.arm
    path, old = arm_file.active_path(name), output.arm
    text = arm_file.before(path)
    new = validate(ArmConfig, parse_yaml(text, str(path)), str(path))
    kept = arm_file.renew(path, text)
    result = {"path": str(path), "changes": _changes(old, new)}
    output.answer(result, lambda: _show_changes(output, result, kept, name))


def _show_changes(output: Output, result: dict[str, Any], kept: Path | None, name: str) -> None:
    show_rows(output.console, "changes", "Changed", result["changes"])
    was = f" (before: {kept})" if kept else ""
    output.say(f"written: {result['path']}{was}\nuse it: armctl daemon --arm {name}")


def _zeroed(output: Output, arm: ArmConfig, pose: str) -> ArmConfig:
    """The arm with the zeros that its servos show while a person holds it limp in a pose."""
    from armctl.commissioning import calibration

    with opened(output, [joint.servo_id for joint in arm.joints]) as bus:
        AtTerminal(output, *ASKED).ask("", f"hold the limp arm still in its {pose} pose")
        ticks = calibration.read_ticks(bus, arm.joints, bus.port.clock)
    return calibration.zeroed(arm, ticks, [joint.rest_rad if pose == "rest" else 0.0 for joint in arm.joints])


def _touch_all(output: Output, arm: ArmConfig, points: Path, touches: int, kept: Path, holding: bool) -> Readings:
    """Lead the person through the points and keep each touch; a reading that fails is taken again."""
    from armctl.commissioning import arm_file, calibration
    from armctl.commissioning.holding import Way, left, most_telling, ways_above

    places = calibration.read_points(points)
    calibration.check_points(arm, places * touches)
    ways = [Way(number, place, k) for number, place in enumerate(places, 1) for k in range(touches)]
    if holding:
        ways = ways_above(arm, places, ABOVE_M)
        for number in sorted({*range(1, len(places) + 1)} - {way.number for way in ways}):
            output.say(f"point {number} is left out: the arm cannot stand {1000.0 * ABOVE_M:.0f} mm above it")
    made, taken, skipped = list[Way](), list[calibration.Touch](), set[int]()
    with ExitStack() as held:
        client = held.enter_context(output.client()) if holding else None
        bus = None if holding else held.enter_context(opened(output, [joint.servo_id for joint in arm.joints]))
        person = AtTerminal(output, *ASKED)
        output.say(f"readings are kept in {kept}, after every touch")
        while due := left(ways, made, skipped, touches):
            way = most_telling(arm, taken, due) if holding else due[0]
            where = f"point {way.number} of {len(places)} ({millimetres(way.point_m)})"
            where += f", posture {[one.number for one in made].count(way.number) + 1} of {touches}"
            try:
                if client is not None:
                    output.say(f"{where}: lead the tip near it, press it onto it with a finger, and press q")
                    key = _led(output, client, way)
                else:
                    key = person.ask("", f"{where}: hold the tip on it ({KEYS})")
                if key == "s":
                    skipped.add(way.number)
                    continue
                if key != "b":
                    ticks = calibration.read_ticks(bus, arm.joints, bus.port.clock) if bus else _standing(output, arm)
                    taken.append(calibration.Touch(point_m=way.point_m, ticks=ticks))
                    made.append(way)
                elif made:
                    taken.pop()
                    skipped.discard(made.pop().number)
            except RequestRefused as refusal:
                output.say(f"not taken: {refusal}")
                continue
            session = calibration.Readings(arm_id=arm.arm_id, touches=tuple(taken))
            arm_file.write(kept, calibration.readings_text(session))
            command = "armctl calibrate" + " --holding" * holding
            output.after_interrupt = f"{len(made)} touches are in {kept}; `{command} --readings` takes them"
    return calibration.Readings(arm_id=arm.arm_id, touches=tuple(taken))


def _led(output: Output, client: Client, way: Way) -> str:
    """Have the daemon bring the tip above a point, in any posture if not in the wanted one; the key that ends it."""
    x, y, z = way.point_m
    # A gripper, and what else moves no tip, stays: it may hold a pointer.
    others = client.call("status")["joints"][len(way.q_rad) :]
    stay = [one["position_rad"] if one["wanted_rad"] is None else one["wanted_rad"] for one in others]
    for target in ({"joints_rad": (*way.q_rad, *stay)}, {"point_m": (x, y, z + ABOVE_M)}):
        try:
            client.call("move", on_progress=None, **target)
            break
        except RequestRefused as refusal:
            output.say(f"not led above it: {refusal}")
    return by_keys(output, client.call, LED_M_S, f"q: take it; {KEYS}", "qsb")


def _standing(output: Output, arm: ArmConfig) -> tuple[float, ...]:
    """Mean position [tick] of every servo of an arm that stands by itself; RequestRefused: it is limp, or moved."""
    from armctl.commissioning.holding import standing_ticks

    with output.client() as watcher:
        return standing_ticks(arm, [snapshot["joints"] for snapshot in islice(watcher.subscribe(), LOOKS)])


def _calibrate_sag(output: Output) -> None:
    """Run the calibration lines on the daemon's arm and keep the sag model."""
    import numpy as np

    from armctl.commissioning import sag_file
    from armctl.lab import sag_identification
    from armctl.lab.rig import DaemonRig

    output.follow_daemon()
    with output.client() as client, output.progress("calibration lines", sag_identification.LINES) as show:
        rig = DaemonRig(client, output.arm)
        model = sag_identification.identify(rig, np.random.default_rng(0), show=show)
    path = sag_file.save(output.config, model)
    residual = dict(zip(rig.arm.joint_names, model.residual_tick, strict=False))
    if not output.result({"path": str(path), "lines": model.lines, "residual_tick": residual}):
        title = f"{path}: sag and friction of {len(residual)} joints from {model.lines} lines"
        show_rows(output.console, "sag", title, [{"joint": name, "tick": tick} for name, tick in residual.items()])
        output.say(below("sag", {}))


def _changes(old_arm: ArmConfig, new_arm: ArmConfig) -> list[dict[str, Any]]:
    """Every value that differs between two calibrations of one arm."""
    from armctl.kinematics import robots

    old, new = (robots.get(arm.robot, arm.lengths_m).lengths_m for arm in (old_arm, new_arm))
    rows: list[tuple[str, Any, Any]] = [(f"lengths_m.{key}", old[key], new[key]) for key in old if key in new]
    for joint, *both in zip(old_arm.joint_names, old_arm.joints, new_arm.joints, strict=True):
        was, now = (one.model_dump(mode="json") for one in both)
        keys = ("zero_tick", "limits_deg", "rest_deg", "pair")
        rows += [(f"{joint}.{key}", was.get(key), now.get(key)) for key in keys]
    rows.append(("ramp_from_reference", old_arm.ramp_from_reference, new_arm.ramp_from_reference))

    def told(arm: ArmConfig) -> dict[str, Any]:
        table = () if isinstance(arm.robot, str) else enumerate(arm.robot.dh, 1)
        dumped = ((i, row.model_dump(mode="json", exclude_defaults=True)) for i, row in table)
        return {f"robot.dh.{i}.{key}": value for i, row in dumped for key, value in row.items()}

    before, after = told(old_arm), told(new_arm)
    rows += [(key, before.get(key), after.get(key)) for key in before | after]
    return [{"key": key, "before": was, "after": now} for key, was, now in rows if was != now]


def show_found(output: Output, table: str, found: dict[str, Any]) -> None:
    """Every parameter, how well all of them fit, and what was left alone."""
    show_rows(output.console, table, "", found["parameters"])
    worst = max(found["residuals_mm"])
    output.say(below(table, found))
    output.say(f"worst point: touch {found['residuals_mm'].index(worst) + 1}, {worst:.2f} mm")
    for parameter in found["parameters"]:
        if parameter.get("held"):
            output.say("{name} is left alone: {held}".format(**parameter))
    if not found.get("complete", True):
        output.say(below("incomplete", found))
