"""armctl as a system service: the files and commands it needs, and how they are done and undone.

Rules.
1. An installation is a list of acts, made before anything is touched: printing it is the dry run.
2. Doing it twice changes nothing; what a person wrote (configuration, calibrations) is never overwritten, and
   neither that nor data is ever removed.
3. Files go below a root folder, commands run only where that is the running system: packages are made, and tests
   run, in any other.
4. The program itself is not copied: the units start the one that installs, which therefore has to lie where a
   system user may read it.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from armctl.errors import ArmctlError, ConfigError
from armctl.files import find_arm_file

SYSTEM = Path("/")
UNITS = ("armctl.service", "armctl-web.service")
ETC = Path("etc/armctl")
RULES = Path("etc/udev/rules.d/60-armctl.rules")
SYSTEMD = Path("etc/systemd/system")
# Kinds of systemd's configuration files, etc/KIND.d/armctl.conf, and what reads each.
CONFIGURED = {"sysusers": ("systemd-sysusers",), "tmpfiles": ("systemd-tmpfiles", "--create")}
TEMPLATE_PREFIX = "/opt/armctl"
# ROBOTIS' present adapter; what the rule is limited to while none is plugged in.
U2D2 = {"idVendor": "0403", "idProduct": "6014"}


class InstallationFailed(ArmctlError):
    """An act could not be done; says which, why and what helps."""


@dataclass(frozen=True)
class File:
    """One file below the root as it is to be."""

    path: Path
    # None: it is not to be there.
    text: str | None
    # A person's file: written only where there is none.
    keep: bool = False

    def __str__(self) -> str:
        if self.text is None:
            return f"remove /{self.path}"
        return f"write /{self.path}" + (" unless it is there" if self.keep else "")

    def due(self, root: Path) -> bool:
        target = root / self.path
        if not target.exists():
            return self.text is not None
        return self.text is None or (not self.keep and target.read_text(encoding="utf-8") != self.text)

    def do(self, root: Path) -> None:
        target = root / self.path
        if self.text is None:
            target.unlink()
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(target.name + ".part")
        partial.write_text(self.text, encoding="utf-8")
        partial.chmod(0o644)
        partial.replace(target)


@dataclass(frozen=True)
class Run:
    """One command of the running system."""

    command: tuple[str, ...]
    # It undoes something that may be gone already.
    may_fail: bool = False

    def __str__(self) -> str:
        return "run " + " ".join(self.command)

    def due(self, root: Path) -> bool:
        return root == SYSTEM

    def do(self, root: Path) -> None:
        try:
            done = subprocess.run(self.command, capture_output=True, text=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InstallationFailed(f"{self}: {error}") from None
        if done.returncode != 0 and not self.may_fail:
            raise InstallationFailed(f"{self}: exit status {done.returncode}: {(done.stderr or done.stdout).strip()}")


Act = File | Run


def installation(
    *, arm: str, port: str = "", user: str = "", prefix: Path | None = None, sysfs: Path = Path("/sys")
) -> list[Act]:
    """What makes armctl a service of this system.

    Args:
        arm: Name or path of the calibration file; it is copied to where the service finds it.
        port: Serial device of the arm; the udev rule is limited to the adapter behind it. Empty: any U2D2.
        user: Who joins the group that may command the arm.
        prefix: Where `bin/armctl` lies; the running environment's unless given.
        sysfs: Where the kernel describes its devices.
    Raises:
        ConfigError: no such arm, no adapter behind the port, or a program that the service could not read.
    """
    prefix = prefix or Path(sys.prefix)
    program = prefix / "bin" / "armctl"
    if not program.is_file():
        raise ConfigError(str(program), "", "no such program", "install armctl into the environment that runs this")
    if any(prefix.is_relative_to(private) for private in ("/home", "/root", "/run/user")):
        install = "/opt/armctl/bin/pip install CHECKOUT_OR_WHEEL, then /opt/armctl/bin/armctl install"
        remedy = f"python3 -m venv /opt/armctl && {install}"
        raise ConfigError(str(prefix), "", "a system service cannot read a program in a home folder", remedy)
    adapter = usb_adapter(Path(port), sysfs) if port else U2D2
    calibration = find_arm_file(arm)
    name = calibration.stem
    joining = [Run(("usermod", "--append", "--groups", "armctl", user))] if user else []
    return [
        *(File(_configuration(kind), template(f"{kind}.conf")) for kind in CONFIGURED),
        *(Run((*command, f"/{_configuration(kind)}")) for kind, command in CONFIGURED.items()),
        File(ETC / "armctl.yaml", f"port: /dev/armctl\narm: {name}\n", keep=True),
        File(ETC / "calibration" / f"{name}.yaml", calibration.read_text(encoding="utf-8"), keep=True),
        File(RULES, udev_rules(adapter)),
        Run(("udevadm", "control", "--reload")),
        Run(("udevadm", "trigger", "--action=add", "--subsystem-match=tty", "--subsystem-match=usb-serial")),
        *joining,
        *(File(SYSTEMD / unit, template(unit).replace(TEMPLATE_PREFIX, str(prefix))) for unit in UNITS),
        Run(("systemctl", "daemon-reload")),
        Run(("systemctl", "enable", "armctl.service")),
        Run(("systemctl", "restart", "armctl.service")),
    ]


def removal() -> list[Act]:
    """What takes the service away; configuration, calibrations, logs and recordings stay."""
    return [
        *(Run(("systemctl", "disable", "--now", unit), may_fail=True) for unit in UNITS),
        *(File(SYSTEMD / unit, None) for unit in UNITS),
        File(RULES, None),
        *(File(_configuration(kind), None) for kind in reversed(CONFIGURED)),
        Run(("systemctl", "daemon-reload")),
        Run(("udevadm", "control", "--reload")),
    ]


def _configuration(kind: str) -> Path:
    return Path("etc") / f"{kind}.d" / "armctl.conf"


def carry_out(acts: Iterable[Act], root: Path, tell: Callable[[Act, bool], None]) -> None:
    """Do what is due.

    Args:
        tell: Called with every act before it is done, and whether it is due.
    Raises:
        InstallationFailed: one could not be done; those before it are.
    """
    for act in acts:
        due = act.due(root)
        tell(act, due)
        if due:
            try:
                act.do(root)
            except OSError as error:
                remedy = "; run it with sudo" if isinstance(error, PermissionError) else ""
                raise InstallationFailed(f"{act}: {error.strerror}{remedy}") from None


def missing_commands(acts: Iterable[Act]) -> list[str]:
    """Commands an installation needs that this system does not have."""
    return sorted({act.command[0] for act in acts if isinstance(act, Run) and shutil.which(act.command[0]) is None})


def udev_rules(adapter: dict[str, str]) -> str:
    """The rules file for one adapter, by its USB attributes."""
    match = ", ".join(f'ATTRS{{{key}}}=="{value}"' for key, value in adapter.items())
    return template("60-armctl.rules").replace("@ADAPTER@", match)


def usb_adapter(port: Path, sysfs: Path) -> dict[str, str]:
    """USB vendor, product and serial number of the adapter behind a serial device.

    Raises:
        ConfigError: there is no such device, or it is none of USB.
    """
    device = sysfs / "class" / "tty" / Path(os.path.realpath(port)).name / "device"
    if not device.exists():
        raise ConfigError(str(port), "", "no such serial device", "plug the adapter in; see ls -l /dev/serial/by-id")
    for folder in (resolved := device.resolve(), *resolved.parents):
        if (folder / "idVendor").is_file():
            found = {key: folder / key for key in ("idVendor", "idProduct", "serial")}
            values = {key: path.read_text().strip() for key, path in found.items() if path.is_file()}
            # A device chooses its own serial number: one that is no plain word does not get into a rule.
            return {key: value for key, value in values.items() if re.fullmatch(r"[A-Za-z0-9._-]+", value)}
    remedy = "write a udev rule of your own for it, and install without --port"
    raise ConfigError(str(port), "", "no USB adapter", remedy)


def template(name: str) -> str:
    """A file of `systemd/`, from the package or from a checkout."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "systemd", package.parent / "systemd"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise InstallationFailed(f"{name} is missing from this installation of armctl; install it again")
