"""Commands that look at the arm or change what it does now."""

import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from armctl.cli.output import HOLDS, SOCKET, Output, command, millimetres
from armctl.cli.parameters import tables
from armctl.cli.screen import Screen, filled
from armctl.cli.tables import joint_cells, show_rows, table_lines
from armctl.client import Client
from armctl.errors import NoDaemon
from armctl.files import served_socket


@command("status", SOCKET)
def status_command(output: Output, every: bool) -> None:
    """Show one snapshot: state, fault, joints, tool.

    Example: armctl status
    """
    if every:
        arms = [_served(output, path.stem) for path in sorted(Path(served_socket("*")).parent.glob("*.sock"))]
        lines = "\n".join(f"{one['arm']:<20} {one['state']}" for one in arms)
        output.answer({"arms": arms}, lines or "no arm is a service of this computer; see `armctl help arm`")
        return
    snapshot = output.ask("status")
    output.answer(snapshot, lambda: output.console.print(*picture(snapshot, output.console)))


def _served(output: Output, name: str) -> dict[str, Any]:
    with suppress(NoDaemon), output.client(socket=served_socket(name), timeout_s=2.0) as client:
        return {"arm": name, **client.call("status")}
    return {"arm": name, "state": "unreachable"}


@command("watch", SOCKET)
def watch_command(output: Output) -> None:
    """Show the snapshot live, until Ctrl-C. This never moves the arm.

    Without a terminal, as in a pipe, one line a second.

    Example: armctl watch
    """
    with output.client() as client, suppress(KeyboardInterrupt):
        for index, snapshot in enumerate(client.subscribe()):
            if output.result(snapshot):
                continue
            if output.console.is_terminal:
                output.console.draw(picture(snapshot, output.console))
            elif index % max(1, round(1.0 / snapshot["period_s"])) == 0:
                print(_line(snapshot), flush=True)


# Characters that show where a joint is between its limits.
BAR = 12


def picture(snapshot: dict[str, Any], screen: Screen) -> list[str]:
    """The lines that show a snapshot."""
    quantities = ("deg/s", "load %", "V", "degC")
    joints = []
    for joint in snapshot["joints"]:
        deg, *others = joint_cells(joint, ("deg", *quantities))
        place = "" if joint["position_rad"] is None else _place(joint)
        torque = {None: "-", True: "on", False: "off"}[joint["torque_enabled"]]
        age = "never" if joint["age_s"] is None else f"{joint['age_s']:.2f}"
        joints.append((joint["name"], str(joint["servo_id"]), deg, place, *others, torque, age))
    columns = ("joint", "id", "deg", "limits", *quantities, "torque", "age s")
    speed_m_s = None if snapshot["tool"] is None else snapshot["tool"]["speed_m_s"]
    limit_m_s = snapshot["tool_speed_limit_m_s"]
    hurried = snapshot["state"] == "teaching" and (speed_m_s or 0.0) > limit_m_s
    warning = f" (keep it below {1000.0 * limit_m_s:.0f})" if hurried else ""
    red = {"fg": "red"}
    lines = screen.wrapped(f"{snapshot['arm_id']}: {snapshot['state']}", bold=True, **red if snapshot["fault"] else {})
    lines += table_lines(screen, columns, joints, ("joint", "limits"))
    lines += screen.wrapped(f"tool at {_tool(snapshot)}{warning}", **red if hurried else {})
    if snapshot["progress"] is not None:
        lines += screen.wrapped(f"{filled(snapshot['progress'], 2 * BAR)} {_progress(snapshot)}")
    if snapshot["recording"]:
        lines += screen.wrapped(f"recording {snapshot['recording']}")
    wrong = [f"logging has stopped: {snapshot['log']['problem']}"] * bool(snapshot["log"]["problem"])
    for fault in snapshot["faults"]:
        follows = f" (follows from {fault['follows']})" if fault["follows"] else ""
        card = f"{fault['code']} since {fault['since_s']:.0f} s{follows}: {fault['text']}"
        wrong += [card, f"  next: {fault['next']}"]
    if fault := snapshot["fault"]:
        wrong.append(f"the arm: {fault['arm']}")
    lines += screen.wrapped("\n".join(wrong), **red)
    if snapshot["notice"]:
        lines += screen.wrapped(f"{snapshot['notice']}\n  to hear no more of it: armctl clear", fg="yellow")
    return lines


def _place(joint: dict[str, Any]) -> str:
    """A joint between its limits, as a mark on a bar; another mark beyond them: at a limit it may well rest."""
    low, high = joint["limits_rad"]
    share: float = (joint["position_rad"] - low) / (high - low)
    at = max(0, min(BAR - 1, math.floor(share * BAR)))
    return "╌" * at + ("●" if 0.0 <= share <= 1.0 else "!") + "╌" * (BAR - 1 - at)


def _tool(snapshot: dict[str, Any]) -> str:
    tool = snapshot["tool"]
    if tool is None:
        return "unknown"
    place = millimetres(tool["position_m"])
    return place if tool["speed_m_s"] is None else f"{place}, {tool['speed_m_s'] * 1000.0:.0f} mm/s"


def _progress(snapshot: dict[str, Any]) -> str:
    rate = snapshot["rate"]
    return f"{snapshot['progress']:.0%} of the way, " + (f"rate {rate:g}" if rate else "paused")


def _line(snapshot: dict[str, Any]) -> str:
    """A snapshot in one line."""
    parts = [f"tick {snapshot['tick']}", snapshot["state"], f"tool {_tool(snapshot)}"]
    known = [joint for joint in snapshot["joints"] if joint["temperature_degC"] is not None]
    if known:
        hottest = max(known, key=lambda joint: float(joint["temperature_degC"]))
        parts.append(f"hottest {hottest['temperature_degC']:.0f} degC ({hottest['name']})")
        parts.append(f"lowest {min(joint['voltage_V'] for joint in known):.1f} V")
    if snapshot["progress"] is not None:
        parts.append(_progress(snapshot))
    parts += [f"{fault['code']}: {fault['text']}; next: {fault['next']}" for fault in snapshot["faults"]]
    return "; ".join(parts)


# ------------------------------------------------------------------------------------ one request, one new state


def request(output: Output, method: str, **params: Any) -> int:
    """Ask the daemon for something that it answers with the arm's new state; the exit status."""
    answer = output.ask(method, **params)
    if why := answer.get("unreached"):
        output.warn(f"armctl: {why}")
        output.refused("PORT_GONE", why, [why], "armctl status", state=answer["state"])
        return 1
    output.answer(answer, str(answer["state"]))
    return 0


def state_command(name: str, group: click.Group | None = None) -> click.Command:
    """A command that is one request without parameters; the daemon's method has the words that are typed.

    Its help stands in the table `states` beside this module.
    """

    def ask(output: Output) -> int:
        output.after_interrupt = HOLDS if name == "park" else ""
        return request(output, "_".join(words))

    words = (str(group.name), name) if group else (name,)
    typed = " ".join(words)
    return command(name, SOCKET, group=group, help=f"{tables('arm')['states'][typed]}\n\nExample: armctl {typed}")(ask)


@click.group("torque")
def torque_command() -> None:
    """Switch the servos' torque on; `armctl release` switches it off.

    Example: armctl torque on
    """


stop_command, hold_command, clear_command = map(state_command, ("stop", "hold", "clear"))
park_command, pause_command, resume_command = map(state_command, ("park", "pause", "resume"))
torque_on = state_command("on", torque_command)


@command("rate", SOCKET)
def rate_command(output: Output, rate: float) -> None:
    """Continue the run at RATE (0.1 to 1) of its planned speed.

    Example: armctl rate 0.5
    """
    request(output, "rate", rate=rate)


# ------------------------------------------------------------------------------------------------- an arm goes limp


def warn_of_limpness(output: Output, client: Client, countdown_s: int, question: str = "") -> None:
    """Give the person time to support an arm that is about to go limp; nothing where it is limp already.

    Args:
        question: Asked before the countdown, where there is one.
    Raises:
        click.Abort: the answer was no.
    """
    if not any(joint["torque_enabled"] for joint in client.call("status")["joints"]):
        return
    output.after_interrupt = "torque stays on"
    if question:
        click.confirm(question, abort=True, err=output.json)
    for left in range(countdown_s, 0, -1):
        output.say(f"support the arm: it goes limp in {left} s (Ctrl-C to keep it)")
        time.sleep(1.0)


@command("release", SOCKET)
def release_command(output: Output, countdown: int) -> None:
    """Switch torque off after a countdown. The arm drops: support it.

    Example: armctl release --countdown 5
    """
    with output.client() as client:
        warn_of_limpness(output, client, countdown)
    request(output, "release", confirm=True)


# ----------------------------------------------------------------------------------------- arms, without any of them


@command("arms")
def arms_command(output: Output) -> None:
    """The arms at hand: those that come with armctl, and your own.

    Example: armctl arms
    """
    from armctl.commissioning.arm_file import arms_at_hand

    rows = arms_at_hand()
    output.answer({"arms": rows}, lambda: show_rows(output.console, "arms", "", rows))


@click.group("arm")
def arm_command() -> None:
    """What describes an arm: its file.

    Example: armctl arm check my-arm.yaml
    """


@command("check", group=arm_command)
def check_command(output: Output, file: str) -> int:
    """Judge the file of an arm without hardware, and draw the arm at rest, from its side.

    Example: armctl arm check my-arm.yaml
    """
    from armctl.commissioning.arm_file import judged

    found = judged(file)
    told = [f"{problem['key']}: {problem['text']}".removeprefix(": ") for problem in found.problems]
    output.answer(found._asdict(), "\n".join([found.picture, *(told or ["nothing is wrong with it"])]).strip("\n"))
    return 0 if found.ok else 1
