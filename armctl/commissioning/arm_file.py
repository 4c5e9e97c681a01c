"""An arm's file: judged without hardware, and drawn; renewed, with its history; and every arm at hand."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.commissioning.calibration import calibration_text
from armctl.commissioning.texts import refusal, said
from armctl.config import ArmConfig
from armctl.errors import ConfigError, LogError
from armctl.files import calibration_dirs, find_arm_file, load_arm, read_text, shipped_dirs
from armctl.kinematics import robots
from armctl.recording.disk import put
from armctl.trajectory.collision import floor_clearance, judged_pairs, link_clearance, link_points

# Characters of a drawing, and what stands for links and joints.
WIDTH, HEIGHT = 56, 24
LINK, JOINT, TOOL, FLOOR = "·", "o", "x", "_"


class Judgement(NamedTuple):
    """What there is to say about an arm's file."""

    ok: bool
    # Each with the key it is about and what is wrong, with the remedy.
    problems: tuple[dict[str, str], ...]
    # The arm from its side, in its rest pose; empty where the file cannot be read.
    picture: str


def judged(path: str) -> Judgement:
    """The file of an arm, given by name or path."""
    try:
        arm = load_arm(path)
        robot = robots.of(arm)
    except ConfigError as error:
        first, *rest = error.problem.split("\n")
        told = [(error.key, first + (f"; {error.remedy}" if error.remedy else ""))]
        told += [(key, text) for key, _, text in (line.strip().partition(": ") for line in rest)]
        return Judgement(False, tuple({"key": key, "text": text} for key, text in told), "")
    points = link_points(robot.chain, np.array([joint.rest_rad for joint in arm.joints[: robot.chain.n]]))
    problems = tuple({"key": key, "text": text} for key, text in _of_rest_pose(arm, points))
    return Judgement(not problems, problems, drawn(points, arm.floor_m))


def _of_rest_pose(arm: ArmConfig, points: np.ndarray) -> Iterator[tuple[str, str]]:
    if len(points) < 3:
        return
    below_m = float(floor_clearance(points, arm.floor_m, arm.link_radius_m).min())
    if below_m < 0.0:
        yield "joints.rest_deg", said("rest in floor", mm=-1e3 * below_m)
    pairs = judged_pairs(points, arm.link_radius_m)
    for (i, j), gap_m in zip(pairs.tolist(), link_clearance(points, pairs, arm.link_radius_m).tolist(), strict=True):
        if gap_m < 0.0:
            yield "joints.rest_deg", said("rest in itself", first=i + 1, second=j + 1, mm=-1e3 * gap_m)


def drawn(points: np.ndarray, floor_m: float) -> str:
    """Links from their side, in characters; joints as `o`, the tool as `x`.

    Args:
        points: Ends of the links [m], shape (n + 1, 3), base first.
    """
    out = points[np.abs(points[:, :2]).sum(axis=1).argmax(), :2]
    level = points[:, :2] @ (out / max(float(np.linalg.norm(out)), 1e-9))
    u, v = np.append(level, level[0]), np.append(points[:, 2], floor_m)
    # A character is twice as high as it is wide.
    scale = max(np.ptp(u) / (WIDTH - 1), np.ptp(v) / (2 * (HEIGHT - 1)), 1e-6)
    # Rows and columns of each end, and of the floor.
    places = np.round([(v.max() - v) / (2 * scale), (u - u.min()) / scale]).astype(int)
    page = np.full((places[0].max() + 1, WIDTH), " ")
    page[places[0, -1]] = FLOOR
    page[tuple(np.linspace(places[:, :-2], places[:, 1:-1], WIDTH, axis=-1).round().astype(int))] = LINK
    page[tuple(places[:, :-1])] = JOINT
    page[tuple(places[:, -2])] = TOOL
    return "\n".join("".join(line).rstrip() for line in page)


def whole_text(arm: str) -> str:
    """The file of an arm, given by name or path, as one text: a URDF beside it is taken in as the table it makes.

    Raises:
        ConfigError: there is none, or it is not acceptable.
    """
    found = load_arm(arm)
    if isinstance(found.robot, str) or not found.robot.urdf:
        return read_text(find_arm_file(arm), "calibration")
    return calibration_text(found, [f"The links are those of {found.robot.urdf}."])


def active_path(arm: str) -> Path:
    """The file that the arm is loaded from, given by name or path, once it is renewed.

    For an arm that comes with armctl it is one's own of that name: nobody writes into a package.

    Raises:
        ConfigError: there is no such arm.
    """
    path = find_arm_file(arm)
    return calibration_dirs()[0] / path.name if path.resolve().parent in shipped_dirs() else path


def renew(path: Path, text: str) -> Path | None:
    """Have an arm's file, or its twin, hold a text, on the disk when this returns; the one before stays in its history.

    Returns:
        Where that one lies, `NAME.history/NUMBER.SUFFIX` beside the file, the oldest 1; None: there was none.
    Raises:
        ConfigError: it cannot be written.
    """
    kept: Path | None = None
    if path.exists() and (old := read_text(path, "file")) != text:
        number = max((int(one.stem) for one in _kept(path)), default=0) + 1
        kept = path.with_suffix(".history") / f"{number}{path.suffix}"
        write(kept, old)
    write(path, text)
    return kept


def before(path: Path) -> tuple[Path, ArmConfig, str]:
    """Where what an arm's file held before it was renewed last is, the arm and the text; if never, those that come with
    armctl under that name.

    Raises:
        ConfigError: there is neither, or it is not acceptable.
    """
    kept = sorted((int(one.stem), one) for one in _kept(path))
    shipped = [file for folder in shipped_dirs() if path.exists() and (file := folder / path.name).exists()]
    if not kept and not shipped:
        raise ConfigError(str(path), "", "has no history: it was never renewed", "there is nothing to take back")
    source = kept[-1][1] if kept else shipped[0]
    try:
        arm = load_arm(str(source), path if kept else None)
        return source, arm, read_text(source, "calibration") if kept else whole_text(str(source))
    except ConfigError as error:
        raise ConfigError(error.file, error.key, error.problem, "mend it, or remove it to go back farther") from None


def _kept(path: Path) -> list[Path]:
    return [one for one in path.with_suffix(".history").glob(f"*{path.suffix}") if one.stem.isdecimal()]


def refuse_taken(*new: Path | None) -> None:
    """Refuse to write a file where there is one (FILE_EXISTS)."""
    if taken := [path for path in new if path is not None and path.exists()]:
        raise refusal("FILE_EXISTS", file=taken[0])


def write(path: Path, text: str) -> None:
    """Have a file hold a text, as a whole and on the disk when this returns.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        put(path, text)
    except LogError as error:
        raise ConfigError(str(path), "", str(error).removeprefix(f"{path}: "), "see who owns its folder") from None


def arms_at_hand() -> list[dict[str, Any]]:
    """Every arm that a name finds, the first of a name; files that cannot be read say so in their title."""
    found: dict[str, dict[str, Any]] = {}
    for folder in calibration_dirs():
        for path in sorted(folder.glob("*.yaml")) if folder.is_dir() else ():
            found.setdefault(path.stem, _told(path, "shipped" if folder in shipped_dirs() else str(folder)))
    return list(found.values())


def _told(path: Path, source: str) -> dict[str, Any]:
    where = {"name": path.stem, "source": source, "path": str(path)}
    try:
        arm = load_arm(str(path))
        counts = {"joints": robots.of(arm).chain.n, "servos": len(arm.servos)}
    except ConfigError as error:
        title = f"cannot be read: {error.key}: {error.problem}".split("\n")[0]
        return {**where, "title": title, "joints": 0, "servos": 0, "gripper": None}
    remark = " ".join(line[1:].strip() for line in read_text(path, "calibration").split("\n") if line.startswith("#"))
    title = remark.partition(". ")[0].partition(": ")[0].rstrip(".") or arm.arm_id
    return {**where, "title": title, **counts, "gripper": arm.gripper and arm.gripper.joint}
