"""`armctl calibrate`: zeros and lengths from touched points, and how the arm sags.

The points are touched with a limp arm, without the daemon; `--holding` and `--sag` ask a running daemon to move it.
"""

from __future__ import annotations

import shlex
import sys
from contextlib import ExitStack
from datetime import date, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armctl.cli.keys import keys
from armctl.cli.motion import by_keys
from armctl.cli.output import ARM, BAUD, CONFIG, PORT, SOCKET, Output, command, millimetres
from armctl.cli.setup import AtTerminal, opened
from armctl.cli.tables import below, show_rows
from armctl.commissioning.texts import said
from armctl.errors import RequestRefused

if TYPE_CHECKING:
    from armctl.client import Client
    from armctl.commissioning.calibration import Touch
    from armctl.commissioning.holding import Point, Way
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
    --sheet draws the points to be printed, or points that are in the arm's reach. With --readings beside --points a
    session that broke off goes on: what was touched counts, the rest is asked for, and both are kept there.

    --sag: a running daemon moves the arm along eight lines. What gravity and friction do to each joint is kept beside
    the calibration, as NAME.sag.json. --pairs, for joints that two servos turn: both are read while you lead the limp
    joint through its range.

    Example: armctl calibrate --points sheet.csv
    """
    from armctl.commissioning import arm_file, calibration, pairs
    from armctl.commissioning import holding as under_torque

    if (sheet := asked.pop("sheet")) is not None:
        _draw_sheet(output, sheet, points, touches, *way, *asked.values())
        return
    readings, zero_at, out, save_readings = (asked[key] for key in ("readings", "zero_at", "out", "save_readings"))
    _refuse_several((points or readings, zero_at), way, (out, save_readings))
    holding = "holding" in way
    if way in (("sag",), ("undo",)):
        (_calibrate_sag if way == ("sag",) else _undo)(output)
        return
    if holding and points is not None:
        output.follow_daemon()
    before = output.arm
    name = output.arm_name or output.config.arm
    path = out or arm_file.active_path(name)
    arm_file.refuse_taken(out, None if save_readings == readings else save_readings)
    more, table = dict[str, Any](), "holding" if holding else "limp"
    if way == ("pairs",):
        after = pairs.measured(before, partial(opened, output), AtTerminal(output, *ASKED))
        remark = "what the two servos of a joint read at the same places"
    elif zero_at is not None:
        after = _zeroed(output, before, zero_at)
        remark = f"zero ticks read in the {zero_at} pose"
    else:
        made = calibration.load_readings(readings, before) if readings else ()
        if points is not None:
            usual = path.with_name(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}.readings")
            made = _touch_all(output, before, points, touches, made, save_readings or readings or usual, holding)
        if save_readings is not None:
            arm_file.write(save_readings, calibration.readings_text(before.arm_id, made))
        more = (under_torque if holding else calibration).fit(before, made)._asdict()
        after = more.pop("arm")
        remark = f"{len(made)} touches, {below(table, more)}"
    text = calibration.calibration_text(after, [f"Calibrated {date.today().isoformat()} from {name}: {remark}."])
    kept = arm_file.renew(path, text)
    result = {"path": str(path), "changes": _changes(before, after)} | more
    if not output.result(result):
        if more:
            show_found(output, table, more)
        _show_changes(output, result, kept, str(name if out is None else out))


def _refuse_several(sources: tuple[Any, ...], way: tuple[str, ...], new: tuple[Path | None, ...]) -> None:
    """Refuse anything but one kind of calibration; points may be touched by an arm that holds itself."""
    holding = way == ("holding",)
    if sum(map(bool, (*sources, *(() if holding else way)))) != 1 or (holding and not sources[0]):
        raise click.UsageError(said("several"))
    if way in (("sag",), ("undo",)) and any(new):
        raise click.UsageError(f"--{way[0]} writes no file of another name; leave out --out and --save-readings")


def _draw_sheet(output: Output, file: Path, points: Path | None, touches: int, *others: Any) -> None:
    """Draw points to be printed; without any, some that are in reach, whose file then lies beside the drawing."""
    from armctl.commissioning import arm_file, calibration, holding
    from armctl.report import sheet

    if any(others):
        raise click.UsageError("--sheet draws a sheet; give nothing else but --points")
    if file.suffix != ".svg":
        raise click.UsageError(f"--sheet draws SVG; give a name that ends in .svg, not {str(file)!r}")
    arm = output.arm
    places = calibration.read_points(points) if points else holding.sheet_points(arm, ABOVE_M)
    calibration.check_points(arm, places * touches)
    doubts = _not_led_onto(places, holding.ways_above(arm, places, ABOVE_M))
    doubts += [said("few", points=len(places), wanted=holding.FEW)] * (len(places) < holding.FEW)
    for doubt in doubts:
        output.warn(f"warning: {doubt}")
    if points is None:
        arm_file.refuse_taken(points := file.with_suffix(".csv"))
        arm_file.write(points, "".join("{:.4f},{:.4f},{:.4f}\n".format(*place) for place in places))
    paper = sheet.write(places, arm.arm_id, arm.floor_m, file)
    output.answer({"sheet": str(file), "paper": paper, "points": str(points)}, count=len(places))


def _undo(output: Output) -> None:
    """Have the arm's file hold what it held before it was renewed last; done twice, it is as it was."""
    from armctl.commissioning import arm_file

    name = output.arm_name or output.config.arm
    path, old = arm_file.active_path(name), output.arm
    source, new, text = arm_file.before(path)
    kept = arm_file.renew(path, text)
    result = {"path": str(path), "changes": _changes(old, new), "in_force": str(source)}
    output.answer(result, lambda: _show_changes(output, result, kept, name))


def _show_changes(output: Output, result: dict[str, Any], kept: Path | None, name: str) -> None:
    show_rows(output.console, "changes", "Changed", result["changes"])
    was = f" (before: {kept})" if kept else ""
    output.say(f"written: {result['path']}{was}\nuse it: armctl daemon --arm {name}")
    if "in_force" in result:
        output.say(f"in force: what {result['in_force']} holds; --undo again brings back what was taken now")


def _zeroed(output: Output, arm: ArmConfig, pose: str) -> ArmConfig:
    """The arm with the zeros that its servos show while a person holds it limp in a pose."""
    from armctl.commissioning import calibration

    with opened(output, [joint.servo_id for joint in arm.joints]) as bus:
        AtTerminal(output, *ASKED).ask("", f"hold the limp arm still in its {pose} pose")
        ticks = calibration.read_ticks(bus, arm.joints, bus.port.clock)
    return calibration.zeroed(arm, ticks, [joint.rest_rad if pose == "rest" else 0.0 for joint in arm.joints])


def _not_led_onto(places: list[Point], ways: list[Way]) -> list[str]:
    """Each point to which none of the ways leads."""
    led = {way.number for way in ways}
    lost = [(number, place) for number, place in enumerate(places, 1) if number not in led]
    return [said("not led", number=n, place=millimetres(place), up_mm=1000.0 * ABOVE_M) for n, place in lost]


def _touch_all(
    output: Output, arm: ArmConfig, points: Path, touches: int, earlier: tuple[Touch, ...], kept: Path, holding: bool
) -> tuple[Touch, ...]:
    """Lead the person through the points and keep each touch; a reading that fails is taken again.

    Args:
        earlier: What was touched before.
        kept: The file that all touches are kept in.
    """
    from armctl.commissioning import arm_file, calibration
    from armctl.commissioning.holding import Way, begun, left, most_telling, touch_by, ways_above

    places = calibration.read_points(points)
    calibration.check_points(arm, places * touches)
    limp = [Way(number, place, k) for number, place in enumerate(places, 1) for k in range(touches)]
    ways = ways_above(arm, places, ABOVE_M) if holding else limp
    for doubt in _not_led_onto(places, ways):
        output.say(f"left out: {doubt}")
    made, skipped, above = begun(arm, earlier, ways, places), set[int](), None

    def keep() -> None:
        arm_file.write(kept, calibration.readings_text(arm.arm_id, made.values()))
        again = f" --readings {shlex.quote(str(kept))}"
        output.kept = said("kept", file=kept, number=len(made), command=output.typed.removesuffix(again) + again)

    with ExitStack() as held:
        client = held.enter_context(output.client()) if holding else None
        bus = None if holding else held.enter_context(opened(output, [joint.servo_id for joint in arm.joints]))
        person = AtTerminal(output, *ASKED)
        if holding:
            held.enter_context(keys(sys.stdin)).wait(0.0)  # no key is shown from here on
        output.say(f"readings are kept in {kept}, after every touch")
        while due := left(ways, made, skipped, touches):
            due = most_telling(arm, [*made.values()], due) if holding else due
            here = [way for way in due if way.number == due[0].number]
            where = f"point {here[0].number} of {len(places)} ({millimetres(here[0].point_m)})"
            where += f", posture {[one.number for one in made].count(here[0].number) + 1} of {touches}"
            try:
                if client is None:
                    key = person.ask("", f"{where}: hold the tip on it ({KEYS})")
                else:
                    if above not in here:
                        output.say(f"{where}: moving above it")
                        above = _moved_above(output, client, here)
                    output.say("lead the tip near it, press it onto it with a finger, and press q")
                    key = by_keys(output, client.call, LED_M_S, f"q: take it; {KEYS}", "qsb")
                if key == "s":
                    skipped.add(here[0].number)
                elif key == "b" and made:
                    skipped.discard(made.popitem()[0].number)
                elif key != "b":
                    ticks = calibration.read_ticks(bus, arm.joints, bus.port.clock) if bus else _standing(output, arm)
                    made[above or here[0]] = touch_by(arm, above or here[0], ticks)
                keep()
            except RequestRefused as refusal:
                output.say(f"not taken: {refusal}")
                above = None if refusal.code == "LIMP" else above  # a limp arm drops
    return tuple(made.values())


def _moved_above(output: Output, client: Client, ways: list[Way]) -> Way:
    """Have the daemon bring the tip above a point, by the first of these ways that it goes, if by none in any posture.

    Returns:
        The way that it went; the first one where none was gone.
    """
    x, y, z = ways[0].point_m
    # A gripper, and what else moves no tip, stays: it may hold a pointer.
    others = client.call("status")["joints"][len(ways[0].q_rad) :]
    stay = [one["position_rad"] if one["wanted_rad"] is None else one["wanted_rad"] for one in others]
    targets = [(way, {"joints_rad": (*way.q_rad, *stay)}) for way in ways]
    for way, target in [*targets, (ways[0], {"point_m": (x, y, z + ABOVE_M)})]:
        try:
            client.call("move", on_progress=None, **target)
            return way
        except RequestRefused as refusal:
            output.say(f"not moved above it: {refusal}")
            if refusal.code not in ("PREFLIGHT", "LIMIT", "UNREACHABLE"):  # no other posture helps
                break
    return ways[0]


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
    old, new = _values(old_arm), _values(new_arm)
    both = ((key, old.get(key), new.get(key)) for key in old | new)
    return [{"key": key, "before": was, "after": now} for key, was, now in both if was != now]


def _values(arm: ArmConfig) -> dict[str, Any]:
    """What a calibration may change of an arm, by the names that people read."""
    from armctl.kinematics import robots

    found = dict[str, Any]((f"lengths_m.{key}", m) for key, m in robots.get(arm.robot, arm.lengths_m).lengths_m.items())
    of_joint = {"zero_tick", "limits_deg", "rest_deg", "pair"}
    tables = [(joint.name, joint.model_dump(mode="json", include=of_joint)) for joint in arm.joints]
    rows = enumerate(() if isinstance(arm.robot, str) else arm.robot.dh, 1)
    tables += [(f"robot.dh.{number}", row.model_dump(mode="json", exclude_defaults=True)) for number, row in rows]
    found |= {f"{name}.{key}": value for name, table in tables for key, value in table.items()}
    return found | {"ramp_from_reference": arm.ramp_from_reference}


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
