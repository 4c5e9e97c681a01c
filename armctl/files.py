"""Where configuration, data and sockets are, and the configuration read from there.

What reads a configuration imports it when it is called: `armctl stop` only asks where the socket is.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config, M


def read_text(path: Path, what: str) -> str:
    """A configuration file's text.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot read the {what}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(str(path), "", f"the {what} is not UTF-8 text") from None


def _user_dir(variable: str, below_home: str) -> Path:
    """One of the user's XDG base folders."""
    return Path(os.environ.get(variable) or Path.home() / below_home)


def _loaded(model: type[M], path: Path, what: str) -> M:
    from armctl.config import parse_yaml, validate

    return validate(model, parse_yaml(read_text(path, what), str(path)), str(path))


def calibration_dirs() -> tuple[Path, ...]:
    """Folders searched for an arm's name, first hit wins."""
    own = _user_dir("XDG_CONFIG_HOME", ".config") / "armctl" / "calibration"
    return (own, Path("/etc/armctl/calibration"), *shipped_dirs())


def shipped_dirs() -> tuple[Path, ...]:
    """Where the arms lie that come with armctl."""
    package = Path(__file__).resolve().parent
    return package / "calibration", package.parent / "calibration"


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
    raise ConfigError(
        arm, "", "no such arm", f"known: {', '.join(sorted(known)) or 'none'}; or give the path of a calibration file"
    )


def load_arm(arm: str) -> ArmConfig:
    """The arm of that name or path."""
    from armctl.config import ArmConfig

    return _loaded(ArmConfig, find_arm_file(arm), "calibration")


def load_config(path: str | None = None) -> Config:
    """The daemon's configuration: `path`, else `ARMCTL_CONFIG`, else the user's or the system's file, else defaults."""
    from armctl.config import Config

    chosen = path or os.environ.get("ARMCTL_CONFIG")
    places = (_user_dir("XDG_CONFIG_HOME", ".config") / "armctl" / "armctl.yaml", Path("/etc/armctl/armctl.yaml"))
    file = Path(chosen) if chosen else next(filter(Path.is_file, places), None)
    return Config() if file is None else _loaded(Config, file, "configuration")


def data_dir(config: Config) -> Path:
    """Folder that holds `logs/`, `recordings/`, `plans/` and `sag/`."""
    return Path(config.data_dir) if config.data_dir else _own_data_dir()


def _own_data_dir() -> Path:
    return _user_dir("XDG_DATA_HOME", ".local/share") / "armctl"


def stop_path(socket: Path) -> Path:
    """Where the daemon that listens at `socket` takes a stop, and nothing else."""
    return socket.with_name(f"{socket.name}.stop")


def socket_path(override: str | None = None) -> Path:
    """Where the daemon listens: `override`, else `ARMCTL_SOCKET`, else the user's or the service's socket."""
    chosen = override or os.environ.get("ARMCTL_SOCKET")
    if chosen:
        return Path(chosen)
    service = Path("/run/armctl/armctl.sock")
    try:
        if service.exists():
            return service
    except PermissionError:  # there is a service, for another group
        return service
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return (Path(runtime) if runtime else _own_data_dir()) / "armctl.sock"
