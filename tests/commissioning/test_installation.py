import stat
from pathlib import Path

import pytest

from armctl.commissioning import installation as module
from armctl.commissioning.installation import SYSTEM, Act, InstallationFailed, Run, carry_out, installation, removal
from armctl.config import parse_yaml
from armctl.errors import ArmctlError, ConfigError
from armctl.files import load_arm
from tests.words import missing

# The configuration and the calibration, which are a person's.
KEPT = ["etc/armctl/armctl.yaml", "etc/armctl/calibration/ax12-line.yaml"]


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    program = tmp_path / "opt" / "armctl" / "bin" / "armctl"
    program.parent.mkdir(parents=True)
    program.touch()
    return program.parent.parent


@pytest.fixture
def acts(prefix: Path) -> list[Act]:
    return installation(arm="ax12-line", prefix=prefix)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "root"


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A kernel that knows a U2D2 behind ttyUSB0, and a serial port that is not of USB."""
    usb = tmp_path / "sys" / "devices" / "usb1" / "1-1"
    (usb / "1-1:1.0" / "ttyUSB0").mkdir(parents=True)
    for key, value in (("idVendor", "0403"), ("idProduct", "6014"), ("serial", "FT4THUX8")):
        (usb / key).write_text(value + "\n")
    plain = tmp_path / "sys" / "devices" / "platform" / "serial8250"
    plain.mkdir(parents=True)
    for name, device in (("ttyUSB0", usb / "1-1:1.0" / "ttyUSB0"), ("ttyS0", plain)):
        tty = tmp_path / "sys" / "class" / "tty" / name
        tty.mkdir(parents=True)
        (tty / "device").symlink_to(device)
    monkeypatch.setattr(module, "SYSFS", tmp_path / "sys")
    return tmp_path / "sys"


def due(acts: list[Act], root: Path) -> list[str]:
    done: list[str] = []
    carry_out(acts, root, lambda act, is_due: done.append(str(act)) if is_due else None)
    return done


def contents(root: Path) -> dict[str, str]:
    return {str(path.relative_to(root)): path.read_text() for path in root.rglob("*") if path.is_file()}


def test_an_installation_is_complete_and_readable_by_the_service(acts: list[Act], prefix: Path, root: Path) -> None:
    due(acts, root)
    found = contents(root)
    units = [f"systemd/system/{name}.service" for name in ("armctl-web-lan", "armctl-web", "armctl", "armctl@")]
    others = ["sysusers.d/armctl.conf", "tmpfiles.d/armctl.conf", "udev/rules.d/60-armctl.rules"]
    assert sorted(found) == [*KEPT, *(f"etc/{name}" for name in units + others)]
    assert f"ExecStart={prefix}/bin/armctl daemon" in found["etc/systemd/system/armctl.service"]
    assert parse_yaml(found["etc/armctl/armctl.yaml"], "armctl.yaml") == {"port": "/dev/armctl", "arm": "ax12-line"}
    assert load_arm(str(root / "etc/armctl/calibration/ax12-line.yaml")) == load_arm("ax12-line")
    assert {stat.S_IMODE(path.stat().st_mode) for path in root.rglob("*") if path.is_file()} == {0o644}


def test_installing_twice_changes_nothing(acts: list[Act], root: Path) -> None:
    assert due(acts, root)
    before = contents(root)
    assert due(acts, root) == []
    assert contents(root) == before


def test_a_persons_configuration_is_kept_and_a_changed_unit_is_renewed(acts: list[Act], root: Path) -> None:
    due(acts, root)
    mine, unit = root / "etc/armctl/armctl.yaml", root / "etc/systemd/system/armctl.service"
    mine.write_text("arm: mine\n")
    unit.write_text("# old\n")
    assert due(acts, root) == ["write /etc/systemd/system/armctl.service"]
    assert mine.read_text() == "arm: mine\n"


def test_removal_leaves_configuration_and_calibrations_and_nothing_else(acts: list[Act], root: Path) -> None:
    due(acts, root)
    due(removal(), root)
    assert sorted(contents(root)) == KEPT
    assert due(removal(), root) == []


def test_commands_run_on_the_running_system_only(prefix: Path, root: Path) -> None:
    commands = [act for act in installation(arm="ax12-line", prefix=prefix, user="eve") if isinstance(act, Run)]
    assert ("usermod", "--append", "--groups", "armctl", "eve") in [act.command for act in commands]
    assert not any(act.due(root) for act in commands)
    assert Run(("true",)).due(SYSTEM)
    assert not Run(("true",), when=lambda: False).due(SYSTEM)


def test_what_is_due_is_settled_before_the_first_act(root: Path) -> None:
    unit = module.File(Path("unit"), "new")
    told: list[bool] = []
    carry_out([unit, module.File(Path("unit"), "new")], root, lambda _, is_due: told.append(is_due))
    assert told == [True, True]  # so a command that runs because of a file still sees that the file changed


def test_a_changed_unit_is_shown_before_it_is_replaced(acts: list[Act], root: Path) -> None:
    due(acts, root)
    files = [act for act in acts if isinstance(act, module.File)]
    assert {file.difference(root) for file in files} == {""}
    unit = root / "etc/systemd/system/armctl.service"
    unit.write_text(unit.read_text() + "# mine\n")
    [shown] = filter(None, (file.difference(root) for file in files))
    assert shown.splitlines()[-1] == "-# mine"


def test_a_unit_that_is_not_utf_8_is_shown_and_replaced(acts: list[Act], prefix: Path, root: Path) -> None:
    due(acts, root)
    unit, before = root / "etc/systemd/system/armctl.service", contents(root)
    with unit.open("ab") as file:
        file.write(b"# caf\xe9\n")
    [shown] = filter(None, (act.difference(root) for act in acts if isinstance(act, module.File)))
    assert shown.splitlines()[-1] == r"-# caf\xe9"
    assert due(acts, root) == ["write /etc/systemd/system/armctl.service"]
    assert contents(root) == before
    unit.write_bytes(b"\xff")
    assert "remove /etc/systemd/system/armctl.service" in due(removal(), root)
    (root / KEPT[1]).write_bytes(b"# caf\xe9\n")
    with pytest.raises(ConfigError, match="is kept, and is not what"):
        installation(arm="ax12-line", prefix=prefix, root=root)


@pytest.mark.parametrize("prefix", ["opt/armctl", "/opt/a b", "/opt/50%", "/opt/$HOME", "/opt/a\nb", "/opt/a\n", "/"])
def test_a_prefix_that_a_unit_would_not_take_is_refused(prefix: str) -> None:
    with pytest.raises(ConfigError, match="absolute path"):
        installation(arm="ax12-line", prefix=Path(prefix))


def test_an_arm_that_is_not_valid_is_refused(prefix: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("arm_id: mine\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml"):
        installation(arm=str(tmp_path / "mine.yaml"), prefix=prefix)


def test_another_arm_is_entered_in_the_configuration_and_nothing_else_of_it_changes(
    acts: list[Act], prefix: Path, root: Path
) -> None:
    due(acts, root)
    config = root / "etc/armctl/armctl.yaml"
    config.write_text("# mine\nperiod_s: 0.05\narm: ax12-line\nport: /dev/ttyAMA0\n")
    assert due(installation(prefix=prefix, root=root), root) == []
    due(installation(arm="xiang-6dof", prefix=prefix, root=root), root)
    assert config.read_text() == "# mine\nperiod_s: 0.05\narm: xiang-6dof\nport: /dev/ttyAMA0\n"
    assert (root / "etc/armctl/calibration/xiang-6dof.yaml").is_file()


def test_an_arm_is_added_to_a_configuration_that_names_none(prefix: Path, root: Path) -> None:
    config = root / "etc/armctl/armctl.yaml"
    config.parent.mkdir(parents=True)
    config.write_text("port: /dev/ttyAMA0")
    due(installation(arm="xiang-6dof", prefix=prefix, root=root), root)
    assert config.read_text() == "port: /dev/ttyAMA0\narm: xiang-6dof\n"


@pytest.mark.parametrize(
    "text",
    [
        "{arm: ax12-line, port: /dev/ttyAMA0}\n",
        '"arm": ax12-line\n',
        "arm : ax12-line\n",
        "port: /dev/ttyAMA0\n...\n",
        "arm: >-\n  ax12-line\n",
    ],
)
def test_a_configuration_in_which_another_arm_cannot_be_entered_is_left_to_its_writer(
    prefix: Path, root: Path, text: str
) -> None:
    config = root / "etc/armctl/armctl.yaml"
    config.parent.mkdir(parents=True)
    config.write_text(text)
    with pytest.raises(ConfigError, match=r"armctl\.yaml: arm: .*write `arm: xiang-6dof` there yourself"):
        installation(arm="xiang-6dof", prefix=prefix, root=root)
    assert contents(root) == {"etc/armctl/armctl.yaml": text}


def test_a_calibration_that_is_kept_is_not_overwritten_by_another_of_its_name(
    acts: list[Act], prefix: Path, root: Path
) -> None:
    due(acts, root)
    kept = root / "etc/armctl/calibration/ax12-line.yaml"
    kept.write_text(kept.read_text().replace("arm_id: ax12-line", "arm_id: mine"))
    with pytest.raises(ConfigError, match="is kept"):
        installation(arm="ax12-line", prefix=prefix, root=root)
    assert due(installation(prefix=prefix, root=root), root) == []


@pytest.mark.parametrize(("unit", "holds"), [
    ("armctl@.service", ("/run/armctl/%i.sock", "/etc/armctl/%i.yaml", "XDG_DATA_HOME=/var/lib/armctl/%i")),
    ("armctl-web-lan.service", ("armctl web --lan", "ipv4:tcp:8443", "IPAddressAllow=any", "=armctl-web-lan")),
])  # fmt: skip
def test_a_unit_made_of_another_has_what_is_its_own(unit: str, holds: tuple[str, ...]) -> None:
    source, changes = module.DERIVED[unit]
    assert all(old in module.template(source) for old in changes)
    assert not missing(module.unit_text(unit, Path("/opt/armctl")), *holds)


@pytest.mark.parametrize("unit", [*module.UNITS, *module.DERIVED])
def test_a_prefix_stands_in_a_unit_as_it_is(unit: str) -> None:
    prefix = Path("/opt/armctl/armctl.8080")
    usual = module.unit_text(unit, Path("/opt/armctl"))
    assert module.unit_text(unit, prefix) == usual.replace("/opt/armctl", str(prefix))


def test_a_command_that_fails_is_named_with_its_words() -> None:
    act = Run(("sh", "-c", "echo no such group >&2; exit 6"))
    with pytest.raises(InstallationFailed, match=r"run sh .*exit status 6: no such group"):
        act.do(SYSTEM)
    Run(act.command, may_fail=True).do(SYSTEM)
    with pytest.raises(InstallationFailed, match="no-such-program"):
        Run(("no-such-program",)).do(SYSTEM)
    assert module.hindrance([act, Run(("no-such-program",))]) == "this system has no no-such-program"


@pytest.mark.parametrize("booted", [True, False])
def test_where_systemd_does_not_run_the_files_are_removed_and_nothing_is_installed(
    booted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BOOTED", tmp_path if booted else tmp_path / "none")
    monkeypatch.setattr("shutil.which", lambda command: None if command == "systemctl" else command)
    runs = [act for act in removal() if isinstance(act, Run) and act.command[0] == "systemctl"]
    assert {act.command[1] for act in runs if act.due(SYSTEM)} == (
        {"stop", "disable", "daemon-reload"} if booted else set()
    )
    assert module.hindrance([Run(("true",))]) == (
        "" if booted else "this system was not started by systemd (a container?)"
    )
    assert module.hindrance(runs) == "this system has no systemctl"


def test_a_folder_that_cannot_be_written_is_told_with_the_act(acts: list[Act], root: Path) -> None:
    root.write_text("a file where a folder should be")
    with pytest.raises(InstallationFailed, match=r"write /etc/sysusers.d/armctl.conf: Not a directory"):
        due(acts, root)


def test_a_program_missing_or_in_a_home_folder_is_refused_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="no such program"):
        installation(arm="ax12-line", prefix=Path("/home/eve/.venv"))
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    with pytest.raises(ConfigError, match=r"home folder; python3 -m venv /opt/armctl"):
        installation(arm="ax12-line", prefix=Path("/home/eve/.venv"))


@pytest.mark.usefixtures("sysfs")
def test_the_rule_is_limited_to_the_adapter_behind_the_port(prefix: Path) -> None:
    acts = installation(arm="ax12-line", prefix=prefix, port="/dev/ttyUSB0")
    [rules] = [act.text or "" for act in acts if isinstance(act, module.File) and act.path.suffix == ".rules"]
    rows = [row for row in rules.splitlines() if not row.startswith("#")]
    adapter = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014", ATTRS{serial}=="FT4THUX8"'
    for row, given in zip(rows, ('MODE="0660", GROUP="armctl"', 'ATTR{latency_timer}="1"'), strict=True):
        assert not missing(row, adapter, given)


def test_a_serial_number_that_is_no_plain_word_does_not_get_into_a_rule(sysfs: Path) -> None:
    (sysfs / "devices/usb1/1-1/serial").write_text('X", RUN+="/bin/sh\n')
    assert "RUN" not in module.udev_rules(module.usb_adapter(Path("/dev/ttyUSB0")))


@pytest.mark.parametrize(("port", "problem"), [("/dev/ttyUSB7", "no such serial device"), ("/dev/ttyS0", "no USB")])
@pytest.mark.usefixtures("sysfs")
def test_a_port_without_an_adapter_is_refused(port: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        module.usb_adapter(Path(port))


def test_an_unknown_arm_is_refused_before_anything_is_touched(prefix: Path) -> None:
    with pytest.raises(ArmctlError, match="no such arm"):
        installation(arm="no-such-arm", prefix=prefix)
