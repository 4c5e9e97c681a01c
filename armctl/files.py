"""Where configuration, data and sockets are, and the configuration read from there.

What reads a configuration imports it when it is called: `armctl stop` only asks where the socket is.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config


def read_text(path: Path, what: str) -> str:
    """A configuration file's text.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ConfigError(str(path), "", f"the {what} is not UTF-8 text") from None
    except (OSError, ValueError) as error:  # ValueError: a path that no system takes
        raise ConfigError(str(path), "", f"cannot read the {what}: {getattr(error, 'strerror', error)}") from None


def _user_dir(variable: str, below_home: str) -> Path:
    """One of the user's XDG base folders."""
    return Path(os.environ.get(variable) or Path.home() / below_home)


def calibration_dirs() -> tuple[Path, ...]:
    """Folders searched for an arm's name, first hit wins."""
    own = _user_dir("XDG_CONFIG_HOME", ".config") / "armctl" / "calibration"
    return (own, Path("/etc/armctl/calibration"), *shipped_dirs())


def shipped_dirs(name: str = "calibration") -> tuple[Path, ...]:
    """Where the arms lie that come with armctl, or what else does: in the package, or in a checkout."""
    package = Path(__file__).resolve().parent
    return package / name, package.parent / name


def find_arm_file(arm: str) -> Path:
    """The calibration file of an arm given by name or path.

    Raises:
        ConfigError: there is none; the message lists the known names.
    """
    from armctl.config import NAME_PATTERN

    if "/" in arm or arm.endswith((".yaml", ".yml")):
        return Path(arm)
    known: set[str] = set()
    for folder in calibration_dirs():
        path = folder / f"{arm}.yaml"
        if re.fullmatch(NAME_PATTERN, arm) and path.is_file():
            return path
        known.update(found.stem for found in folder.glob("*.yaml") if folder.is_dir())
    names = ", ".join(sorted(known)) or "none"
    raise ConfigError(arm, "", "no such arm", f"known: {names}; or give the path of a calibration file")


def load_arm(arm: str, beside: Path | None = None) -> ArmConfig:
    """The arm of that name or path, whole: a URDF that its file names is read and made the table in it.

    Args:
        beside: The file beside which the URDF lies; None: the arm's own.
    Raises:
        ConfigError: the file, its URDF, or what they say of the robot is not acceptable.
    """
    from armctl.config import ArmConfig, parse_yaml, validate

    path = find_arm_file(arm)
    told = parse_yaml(read_text(path, "calibration"), str(path))
    if isinstance(robot := told.get("robot"), dict) and "urdf" in robot and "dh" not in robot:
        told = _with_urdf(told, robot, path, (beside or path).parent)
    found = validate(ArmConfig, told, str(path))
    from armctl.kinematics import robots

    try:
        robots.of(found)
    except ConfigError as error:
        key = error.key if error.key in ("joints", found.robot) else f"lengths_m.{error.key}"
        raise ConfigError(str(path), key, error.problem, error.remedy) from None
    return found


def driven_arm(first: str, told: dict[str, Any], others: bool = True) -> tuple[str, ArmConfig]:
    """The arm that the daemon drives, behind the name or path by which it was found.

    Args:
        first: The arm that is looked at first, by name or path.
        told: The daemon's status.
        others: Whether it may be any other one at hand.
    Raises:
        ConfigError: no file of an arm says the same of it.
    """
    folders = calibration_dirs() if others else ()
    for name in (first, *(str(path) for folder in folders for path in sorted(folder.glob("*.yaml")))):
        with suppress(ConfigError):
            arm = load_arm(name)
            if (arm.arm_id, arm.calibration_hash) == (told["arm_id"], told["calibration_hash"]):
                return name, arm
    problem = f"the daemon drives arm {told['arm_id']}, calibration {told['calibration_hash']}; this is another"
    how = "as `arm` in the configuration" if others else "by --arm"
    raise ConfigError(first, "", problem, f"restart the daemon, or name the file of its arm {how}")


def _with_urdf(told: dict[str, Any], robot: dict[str, Any], path: Path, folder: Path) -> dict[str, Any]:
    """An arm's file with the table of its URDF, and the URDF's limits where the file gives a joint none."""
    from armctl.kinematics.urdf_reader import read

    if set(robot) != {"urdf", "tool"} or not all(isinstance(value, str) for value in robot.values()):
        raise ConfigError(str(path), "robot", f"has the keys {', '.join(robot)}", "a URDF takes `urdf` and `tool`")
    file = folder / robot["urdf"]
    found = read(_urdf_text(file), robot["tool"], str(file))
    for link, mesh in found.meshes:
        if not os.path.isfile(file.parent / mesh.rpartition("://")[2]):  # unlike Path.is_file of an over-long name, too
            text = f"mesh {mesh!r} is not there; armctl draws links by itself"
            raise ConfigError(str(file), f"link {link}", text, "put it there, or remove the <mesh>")
    if isinstance(joints := told.get("joints"), list) and all(isinstance(joint, dict) for joint in joints):
        told["joints"] = [*map(dict, joints)]
        of_urdf = zip(told["joints"], found.joint_names, found.limits_deg, strict=False)
        for index, (joint, name, limits) in enumerate(of_urdf):
            if joint.get("name") != name and joint.get("name") in found.joint_names:
                text = f"{joint['name']} stands in place {index + 1}, where the URDF has {name}"
                raise ConfigError(str(path), f"joints.{index}.name", text, "give joints in the URDF's order")
            if limits is not None:
                joint.setdefault("limits_deg", list(limits))
    return told | {"robot": found.table | {"urdf": robot["urdf"]}}


def _urdf_text(file: Path) -> str:
    """The text of a URDF; a xacro is expanded by the package `xacro`.

    Raises:
        ConfigError: there is no such file, or no such package.
    """
    if file.suffix != ".xacro":
        return read_text(file, "URDF")
    try:
        import xacro
    except ImportError:
        remedy = f"pip install xacro, or expand it: xacro {file.name} > {file.stem}"
        raise ConfigError(str(file), "", "is a xacro, and the package `xacro` is not installed", remedy) from None
    try:
        return str(xacro.process_file(str(file)).toxml())
    except Exception as error:  # of many classes, whatever stands in the file
        raise ConfigError(str(file), "", f"xacro cannot expand it: {str(error).strip()}") from None


def load_config(path: str | None = None) -> Config:
    """The daemon's configuration, of `config_file`; defaults where there is none."""
    from armctl.config import Config, parse_yaml, validate

    if (file := config_file(path)) is None:
        return Config()
    return validate(Config, parse_yaml(read_text(file, "configuration"), str(file)), str(file))


def config_file(path: str | None = None) -> Path | None:
    """`path`, else `ARMCTL_CONFIG`, else the user's or the system's file, whichever is there."""
    if chosen := path or os.environ.get("ARMCTL_CONFIG"):
        return Path(chosen)
    places = (_user_dir("XDG_CONFIG_HOME", ".config") / "armctl" / "armctl.yaml", Path("/etc/armctl/armctl.yaml"))
    return next(filter(Path.is_file, places), None)


def tokens_path(path: str | None = None) -> Path:
    """Where people's tokens for the dashboard are kept: beside the configuration."""
    file = config_file(path)
    return (file.parent if file else _user_dir("XDG_CONFIG_HOME", ".config") / "armctl") / "web-tokens.json"


def data_dir(config: Config) -> Path:
    """Folder that holds `logs/`, `recordings/`, `plans/` and `sag/`."""
    return Path(config.data_dir) if config.data_dir else _own_data_dir()


def logs_dir(path: str | None = None) -> Path:
    """Folder of the daemon's logs, by the configuration that `config_file` finds.

    Where there is none, none is read: that takes as long as asking thousands of logs.
    """
    return (data_dir(load_config(path)) if config_file(path) else _own_data_dir()) / "logs"


def _own_data_dir() -> Path:
    return _user_dir("XDG_DATA_HOME", ".local/share") / "armctl"


def is_file(recording: str) -> bool:
    """Whether what a person typed for a recording means a file, also one of the current folder, and is no name."""
    return "/" in recording or recording.endswith((".csv", ".mcap"))


def stop_path(socket: Path) -> Path:
    """Where the daemon that listens at `socket` takes a stop, and nothing else."""
    return socket.with_name(f"{socket.name}.stop")


def served_socket(name: str) -> str:
    """Where the service armctl@NAME listens; that of armctl itself is called armctl."""
    return f"/run/armctl/{name}.sock"


def socket_path(override: str | None = None) -> Path:
    """Where the daemon listens: `override`, else `ARMCTL_SOCKET`, else the user's or the service's socket."""
    chosen = override or os.environ.get("ARMCTL_SOCKET")
    if chosen:
        return Path(chosen)
    service = Path(served_socket("armctl"))
    try:
        if service.exists():
            return service
    except PermissionError:  # there is a service, for another group
        return service
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return (Path(runtime) if runtime else _own_data_dir()) / "armctl.sock"
