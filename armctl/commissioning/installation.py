"""armctl as a system service: the files and commands it needs, and how they are done and undone.

Rules.
1. An installation is a list of acts, made before anything is touched: printing it is the dry run. Which of them are due
   is settled before the first is done.
2. Doing it twice changes nothing and restarts nothing; what a person wrote (configuration, calibrations) is never
   overwritten, save the name of the arm where another is asked for, and neither that nor data is ever removed.
3. Files go below a root folder, commands run only where that is the running system: packages are made, and tests
   run, in any other.
4. The program itself is not copied: the units start the one that installs, which therefore has to lie where a
   system user may read it.
"""

import difflib
import grp
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import yaml

from armctl.commissioning.arm_file import whole_text
from armctl.commissioning.texts import said
from armctl.config import NAME_PATTERN, Config, parse_yaml, validate
from armctl.errors import ArmctlError, ConfigError
from armctl.files import find_arm_file, load_arm, load_config, shipped_dirs

SYSTEM = Path("/")
# Where the kernel describes its devices.
SYSFS = Path("/sys")
# There where systemd runs the system.
BOOTED = Path("/run/systemd/system")
UNITS = ("armctl.service", "armctl-web.service")
# Unit -> the one that it is made of, and what it has instead of what.
DERIVED: dict[str, tuple[str, dict[str, str]]] = yaml.safe_load(Path(__file__).with_name("units.yaml").read_bytes())
# What a line of a unit holds without quotes.
PLAIN_PATH = r"(?:/[A-Za-z0-9._+-]+)+"
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


class File(NamedTuple):
    """One file below the root as it is to be."""

    path: Path
    # None: it is not to be there.
    text: str | None
    # A person's file: written only where there is none.
    keep: bool = False

    def __str__(self) -> str:
        kept = " unless it is there" if self.keep else ""
        return f"remove /{self.path}" if self.text is None else f"write /{self.path}{kept}"

    def there(self, root: Path) -> str | None:
        """The text that is there, bytes that are no UTF-8 as escapes; None: there is no file."""
        target = root / self.path
        return target.read_text(encoding="utf-8", errors="backslashreplace") if target.exists() else None

    def due(self, root: Path) -> bool:
        return (there := self.there(root)) != self.text and (there is None or not self.keep)

    def difference(self, root: Path) -> str:
        """What a text that is there loses and gets; empty: nothing."""
        there = self.there(root)
        if self.text is None or there is None or self.keep:
            return ""
        names = f"/{self.path}", "as it is to be"
        return "\n".join(difflib.unified_diff(there.splitlines(), self.text.splitlines(), *names, n=0, lineterm=""))

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


class Run(NamedTuple):
    """One command of the running system."""

    command: tuple[str, ...]
    # It undoes something that may be gone already.
    may_fail: bool = False
    # Only where this holds before the first act is done.
    when: Callable[[], bool] = lambda: True

    def __str__(self) -> str:
        return "run " + " ".join(self.command)

    def due(self, root: Path) -> bool:
        return root == SYSTEM and self.when()

    def do(self, root: Path) -> None:
        try:
            done = subprocess.run(self.command, capture_output=True, text=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InstallationFailed(f"{self}: {error}") from None
        if done.returncode != 0 and not self.may_fail:
            raise InstallationFailed(f"{self}: exit status {done.returncode}: {(done.stderr or done.stdout).strip()}")


Act = File | Run


def installation(
    *, arm: str | None = None, port: str = "", user: str = "", prefix: Path | None = None, root: Path = SYSTEM
) -> list[Act]:
    """What makes armctl a service of this system.

    Args:
        arm: Name or path of the calibration file; it is copied to where the service finds it. None: the arm that is
            configured, else the usual one.
        port: Serial device of the arm; the udev rule is limited to the adapter behind it. Empty: for any U2D2. A rule
            that is there stays as it is if the port is empty, or not plugged in.
        user: Who joins the group that may command the arm.
        prefix: Where `bin/armctl` lies; the running environment's unless given.
        root: Below which it is written.
    Raises:
        ConfigError: no such arm or not a valid one, no adapter behind the port, or a program that the service could not
            start.
    """
    prefix = prefix or Path(sys.prefix)
    _check_program(prefix)
    configured, calibration = _settings(arm, root)
    there = (root / RULES).exists()
    rules = File(RULES, udev_rules(U2D2), keep=there)
    if port and (Path(port).exists() or not there):
        rules = File(RULES, udev_rules(usb_adapter(Path(port))))
    units = {unit: File(SYSTEMD / unit, unit_text(unit, prefix)) for unit in (*UNITS, *DERIVED)}
    made = {kind: File(_configuration(kind), template(f"{kind}.conf")) for kind in CONFIGURED}
    seen = ("udevadm", "trigger", "--action=add", "--subsystem-match=tty", "--subsystem-match=usb-serial")
    join, enable = ("usermod", "--append", "--groups", "armctl", user), ("systemctl", "enable", "armctl.service")

    def changed(*files: File) -> Callable[[], bool]:
        return lambda: any(file.due(SYSTEM) for file in files)

    def restart(unit: str) -> Run:
        due = changed(units[re.sub("@.*[.]", "@.", unit)], *((configured, calibration) if unit == UNITS[0] else ()))
        return Run(("systemctl", "restart", unit), when=lambda: due() or _behind(unit, prefix))

    def heard() -> bool:
        """Whether a udev runs that is to be told."""
        return rules.due(SYSTEM) and Path("/run/udev/control").exists()

    return [
        *made.values(),
        *(Run((*run, f"/{_configuration(kind)}"), when=changed(made[kind])) for kind, run in CONFIGURED.items()),
        configured,
        calibration,
        rules,
        Run(("udevadm", "control", "--reload"), when=heard),
        Run(seen, when=heard),
        *([Run(join, when=lambda: not _belongs(user))] if user else []),
        *units.values(),
        Run(("systemctl", "daemon-reload"), when=changed(*units.values())),
        Run(enable, when=lambda: _said("is-enabled", UNITS[0]).strip() != "enabled"),
        *(restart(unit) for unit in dict.fromkeys((UNITS[0], *_running(root)))),
    ]


def _check_program(prefix: Path) -> None:
    program = prefix / "bin" / "armctl"
    if not re.fullmatch(PLAIN_PATH, str(prefix)):
        raise ConfigError(str(prefix), "--prefix", said("prefix"), "install armctl in /opt/armctl")
    if not program.is_file():
        raise ConfigError(str(program), "", "no such program", "install armctl into the environment that runs this")
    if any(prefix.is_relative_to(private) for private in ("/home", "/root", "/run/user")):
        raise ConfigError(str(prefix), "", said("home"), said("home, help"))


def _settings(arm: str | None, root: Path) -> tuple[File, File]:
    """The configuration and the calibration as they are to be."""
    path, folder = root / ETC / "armctl.yaml", root / ETC / "calibration"
    there = load_config(str(path)).arm if path.exists() else ""
    here = folder / f"{there}.yaml"
    source = here if arm is None and here.is_file() else find_arm_file(arm or there or "ax12-line")
    load_arm(str(source))
    name, told = source.stem, whole_text(str(source))
    if not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError(str(source), "", "its name is no name of an arm", "letters, digits, '.', '_', '-'")
    target = folder / f"{name}.yaml"
    if arm is not None and target.exists() and File(target, told).due(Path()):
        raise ConfigError(str(target), "", *said("kept file", source=source, target=target).split("; ", 1))
    text, keep = f"port: /dev/armctl\narm: {name}\n", True
    if there and arm is not None and there != name:
        before = path.read_text(encoding="utf-8").rstrip() + "\n"
        text = re.sub(r"(?m)^arm:.*\n|\Z", f"arm: {name}\n", before, count=1)
        with suppress(ConfigError):
            keep = validate(Config, parse_yaml(text, str(path)), str(path)).arm != name
        if keep:  # the file says it in a way of its own
            raise ConfigError(str(path), "arm", f"{name} cannot be entered here", f"write `arm: {name}` there yourself")
    return File(ETC / "armctl.yaml", text, keep), File(target.relative_to(root), told, keep=True)


def _belongs(user: str) -> bool:
    with suppress(KeyError):
        return user in grp.getgrnam("armctl").gr_mem
    return False


def _said(*command: str) -> str:
    """What systemctl prints; nothing where there is none."""
    with suppress(OSError, subprocess.TimeoutExpired):
        return subprocess.run(("systemctl", *command), capture_output=True, text=True, timeout=60).stdout
    return ""


def _running(root: Path) -> list[str]:
    """Units of armctl that run now."""
    said = _said("list-units", "--plain", "--no-legend", "--state=active", "armctl*.service") if root == SYSTEM else ""
    known = {*UNITS, *DERIVED}
    return [unit for unit in (line.split()[0] for line in said.splitlines()) if re.sub("@.*[.]", "@.", unit) in known]


def _behind(unit: str, prefix: Path) -> bool:
    """Whether a service does not run, or was started before its program was installed."""
    said = _said("show", unit, "--timestamp=unix", "--property=ActiveState,ExecMainStartTimestamp")
    since = re.search(r"ExecMainStartTimestamp=@(\d+)", said)
    if "ActiveState=active" not in said or since is None:
        return True
    records = prefix.glob("lib/python3*/site-packages/armctl-*.dist-info/RECORD")
    return any(record.stat().st_mtime >= int(since[1]) for record in records)


def removal() -> list[Act]:
    """What takes the service away; configuration, calibrations, logs and recordings stay."""
    units, booted = (*UNITS, *DERIVED), BOOTED.is_dir
    stop = ("systemctl", "stop", *UNITS, "armctl@*.service", "armctl-web-lan.service")
    return [
        Run(stop, may_fail=True, when=booted),
        *(Run(("systemctl", "disable", unit), may_fail=True, when=booted) for unit in units),
        *(File(SYSTEMD / unit, None) for unit in units),
        File(RULES, None),
        *(File(_configuration(kind), None) for kind in reversed(CONFIGURED)),
        Run(("systemctl", "daemon-reload"), when=booted),
        Run(("udevadm", "control", "--reload"), when=Path("/run/udev/control").exists),
    ]


def unit_text(unit: str, prefix: Path) -> str:
    """A unit that starts the program in `prefix`; some are made of another."""
    source, changes = DERIVED.get(unit, (unit, {}))
    text = template(source)
    for old, new in {**changes, TEMPLATE_PREFIX: str(prefix)}.items():
        text = text.replace(old, new)
    return text


def _configuration(kind: str) -> Path:
    return Path("etc") / f"{kind}.d" / "armctl.conf"


def carry_out(acts: Iterable[Act], root: Path, tell: Callable[[Act, bool], None], *, dry_run: bool = False) -> None:
    """Do what is due.

    Args:
        tell: Called with every act before it is done, and whether it is due.
        dry_run: Only tell.
    Raises:
        InstallationFailed: one could not be done; those before it are.
    """
    for act, due in [(act, act.due(root)) for act in acts]:
        tell(act, due)
        if due and not dry_run:
            try:
                act.do(root)
            except OSError as error:
                remedy = "; run it with sudo" if isinstance(error, PermissionError) else ""
                raise InstallationFailed(f"{act}: {error.strerror}{remedy}") from None


def hindrance(acts: Iterable[Act]) -> str:
    """Why the commands of an installation cannot be run here; empty: they can. A udev that does not run needs none."""
    needed = {act.command[0] for act in acts if isinstance(act, Run)} - {"udevadm"}
    if missing := sorted(command for command in needed if shutil.which(command) is None):
        return f"this system has no {', '.join(missing)}"
    return "" if BOOTED.is_dir() else "this system was not started by systemd (a container?)"


def udev_rules(adapter: dict[str, str]) -> str:
    """The rules file for one adapter, by its USB attributes."""
    match = ", ".join(f'ATTRS{{{key}}}=="{value}"' for key, value in adapter.items())
    return template("60-armctl.rules").replace("@ADAPTER@", match)


def usb_adapter(port: Path) -> dict[str, str]:
    """USB vendor, product and serial number of the adapter behind a serial device.

    Raises:
        ConfigError: there is no such device, or it is none of USB.
    """
    device = SYSFS / "class" / "tty" / Path(os.path.realpath(port)).name / "device"
    if not device.exists():
        raise ConfigError(str(port), "", "no such serial device", "plug the adapter in; see ls -l /dev/serial/by-id")
    for folder in (resolved := device.resolve(), *resolved.parents):
        if (folder / "idVendor").is_file():
            found = {key: folder / key for key in ("idVendor", "idProduct", "serial")}
            values = {key: path.read_text().strip() for key, path in found.items() if path.is_file()}
            # A device chooses its own serial number: one that is no plain word does not get into a rule.
            return {key: value for key, value in values.items() if re.fullmatch(r"[A-Za-z0-9._-]+", value)}
    raise ConfigError(str(port), "", "no USB adapter", "write a udev rule of your own, and install without --port")


def template(name: str) -> str:
    """A file of `systemd/`, from the package or from a checkout."""
    for folder in shipped_dirs("systemd"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise InstallationFailed(f"{name} is missing from this installation of armctl; install it again")
