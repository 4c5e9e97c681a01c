"""What the doctor finds on arms with planted troubles."""

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import yaml

from armctl.commissioning import doctor
from armctl.commissioning.doctor import Check, Surroundings, check_host, check_port, check_servos
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import PortBusy, PortGone, PortMissing
from tests.commissioning.bench import Bench, unwritten

PERIOD_S = 0.1


def surroundings(folder: Path, **changes: object) -> Surroundings:
    return Surroundings(**{"daemon": "", "log_dir": folder / "logs", "free_bytes": 0, "sysfs": folder, **changes})  # type: ignore[arg-type]


def examine(bench: Bench, folder: Path, **changes: object) -> dict[tuple[str, int | None], Check]:
    checks = check_servos(bench.bus, bench.config, PERIOD_S, surroundings(folder, **changes))
    assert len({(check.name, check.servo_id) for check in checks}) == len(checks)
    assert all(bool(check.fix) != check.ok for check in checks)
    return {(check.name, check.servo_id): check for check in checks}


def failed(checks: dict[tuple[str, int | None], Check]) -> set[tuple[str, int | None]]:
    return {key for key, check in checks.items() if not check.ok}


@pytest.fixture
def bench() -> Bench:
    """An arm with nothing wrong but what the test does to it."""
    bench = Bench()
    for servo in bench.servos:
        servo.set(ax12a.RETURN_DELAY, 0)
    return bench


def test_a_fit_arm_passes_and_nothing_is_written(bench: Bench, tmp_path: Path) -> None:
    with unwritten(bench):
        checks = examine(bench, tmp_path)
    assert failed(checks) == set()
    assert checks["cycle_rate", None].value.startswith("2.4 ms a cycle of 100 ms")
    assert len(checks) == 3 + 6 * 13


@pytest.mark.parametrize("seed", range(4))
def test_slow_adapter_return_delay_and_a_wrong_id_are_all_named_with_their_fixes(tmp_path: Path, seed: int) -> None:
    bench = Bench(seed=seed, latency_ms=16.0)
    bench.servos[3].set(ax12a.ID, 9)
    checks = examine(bench, tmp_path, options=" --port /dev/x")
    assert failed(checks) == {
        ("adapter_latency", None), ("present", 4), ("wrong_id", 9), *(("return_delay", i) for i in (1, 2, 3, 5, 6)),
    }  # fmt: skip
    assert "latency_timer" in checks["adapter_latency", None].fix
    assert checks["present", 4].fix == checks["wrong_id", 9].fix == "armctl servo set-id 9 4 --port /dev/x"
    assert "wrist" in checks["present", 4].value
    remedy = "armctl servo set-return-delay 1 0 --port /dev/x"
    assert checks["return_delay", 1] == Check("return_delay", False, "500 us (register 250)", remedy, 1)


def test_slow_adapter_also_costs_the_cycle_and_return_delay_is_set_for_all(tmp_path: Path) -> None:
    checks = examine(Bench(latency_ms=16.0), tmp_path)
    assert ("cycle_rate", None) in failed(checks)
    assert checks["return_delay", 6].fix == "armctl servo set-return-delay all 0"


TROUBLES = yaml.safe_load(Path(__file__).with_name("troubles.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("trouble", TROUBLES, ids=lambda trouble: str(trouble["value"]))
def test_each_trouble_of_a_servo_is_a_line_with_one_fix(bench: Bench, tmp_path: Path, trouble: dict[str, Any]) -> None:
    for name, value in trouble.get("conditions", {}).items():
        setattr(bench.servos[1], name, value)
    for register in ax12a.REGISTERS:
        if register.name in trouble.get("registers", {}):
            bench.servos[1].set(register, trouble["registers"][register.name])
    checks = examine(bench, tmp_path)
    assert failed(checks) == {(name, 2) for name in trouble["fails"]}
    worst = checks[trouble["fails"][0], 2]
    assert trouble["value"] in worst.value
    assert trouble["fix"] in worst.fix


def test_torque_that_is_on_is_told_and_no_trouble(bench: Bench, tmp_path: Path) -> None:
    bench.servos[0].set(ax12a.TORQUE_ENABLE, 1)
    checks = examine(bench, tmp_path)
    assert (checks["torque", 1], checks["torque", 2].value) == (Check("torque", True, "on", "", 1), "off")


def test_two_servos_with_one_id_are_told(bench: Bench, tmp_path: Path) -> None:
    bench.servos[3].set(ax12a.ID, 3)
    checks = examine(bench, tmp_path)
    assert failed(checks) == {("id_clash", 3), ("present", 4)}
    assert "armctl servo set-id 3 NEW" in checks["id_clash", 3].fix
    assert "check the cable" in checks["present", 4].fix


def test_a_stranger_beside_a_full_arm_is_told(bench: Bench, tmp_path: Path) -> None:
    bench.config = ArmConfig(arm_id="short", robot=bench.config.robot, joints=bench.config.joints[:5])
    assert failed(examine(bench, tmp_path)) == {("wrong_id", 6)}


def test_a_servo_at_another_baud_is_found_and_brought_back(bench: Bench, tmp_path: Path) -> None:
    bench.servos[1].set(ax12a.BAUD, 34)
    checks = examine(bench, tmp_path)
    assert failed(checks) == {("present", 2)}
    assert checks["present", 2].fix == "armctl servo set-baud 2 1000000 --baud 57600"
    assert bench.port.baudrate == 1_000_000


def test_a_whole_bus_at_another_baud_or_without_supply_is_told(bench: Bench, tmp_path: Path) -> None:
    for servo in bench.servos:
        servo.set(ax12a.BAUD, 34)
    checks = examine(bench, tmp_path)
    assert checks["baud", None].value == "nobody answers at 1000000, but servos 1, 2, 3, 4, 5, 6 at 57600"
    assert checks["baud", None].fix == "armctl servo set-baud 1 1000000 --baud 57600"
    bench.line.baud = 1
    for servo in bench.servos:
        servo.set(ax12a.RETURN_LEVEL, 0)
        servo.set(ax12a.ID, 253)
        servo.set(ax12a.BAUD, 254)
    assert "supply" in examine(bench, tmp_path)["baud", None].fix


def test_a_port_that_vanishes_is_raised(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def unplug(*_: object) -> Check:
        bench.bus.close()
        return Check("x", True, "")

    monkeypatch.setattr(doctor, "_cycle_check", unplug)
    with pytest.raises(PortGone):
        check_servos(bench.bus, bench.config, PERIOD_S, surroundings(tmp_path))


# ---------------------------------------------------------------------------------------------------- host and port


def test_host_checks_need_no_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    by_name = {check.name: check for check in check_host(surroundings(tmp_path, daemon="/run/x"))}
    assert all(check.ok for check in by_name.values())
    assert by_name["daemon"].value == "runs: /run/x"
    [full] = [check for check in check_host(surroundings(tmp_path, free_bytes=1 << 60)) if not check.ok]
    assert (full.name, full.fix) == ("disk", f"make room in {tmp_path}, or set log.free_bytes lower")
    monkeypatch.setattr("os.access", lambda *_: False)
    [locked] = [check for check in check_host(surroundings(tmp_path)) if not check.ok]
    assert "not writable" in locked.value
    assert "chown" in locked.fix


def test_the_port_is_shown_with_the_name_that_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    device, link = tmp_path / "ttyUSB0", tmp_path / "by-id" / "usb-FTDI"
    device.touch()
    link.parent.mkdir()
    link.symlink_to(device)
    (link.parent / "other").symlink_to(tmp_path)
    monkeypatch.setattr("armctl.dynamixel.serial_port.BY_ID", link.parent)
    for path, shown in ((device, f"{device} = {link}"), (tmp_path / "ttyUSB1", str(tmp_path / "ttyUSB1"))):
        bench.bus.close()
        bench.port.port_name = str(path)
        assert check_port(bench.bus, surroundings(tmp_path))[0] == Check("port", True, shown)


def test_latency_of_the_driver_is_read_and_its_fix_is_exact(tmp_path: Path) -> None:
    bench = Bench()
    bench.bus.close()
    timer = tmp_path / "class" / "tty" / "loopback" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    bench.port.low_latency = False
    checks = check_port(bench.bus, surroundings(tmp_path))
    assert [(check.name, check.ok) for check in checks] == [
        ("port", True), ("permission", True), ("owner", True), ("low_latency", False), ("latency_timer", False),
    ]  # fmt: skip
    assert {check.fix for check in checks[3:]} == {f"echo 1 | sudo tee {timer}"}
    assert bench.bus.is_open
    timer.write_text("1\n")
    bench.port.low_latency = True
    assert all(check.ok for check in check_port(bench.bus, surroundings(tmp_path)))


BUSY = PortBusy("p: in use by x (pid 7); stop it")
FORBIDDEN = PortMissing("p: no permission; it belongs to group dialout: sudo usermod -aG dialout $USER")


@pytest.mark.parametrize(
    ("error", "daemon", "names", "value", "fix"),
    [
        (PortMissing("p: no such port; found: none; plug it in"), "", "port", "found: none", "plug it in"),
        (BUSY, "", "port owner", "x (pid 7)", "stop it"),
        (BUSY, "/run/s", "port owner", "x (pid 7)", "armctl status"),
        (FORBIDDEN, "", "port permission", "no permission", "usermod"),
    ],
)
def test_a_port_that_does_not_open_ends_the_examination(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, daemon: str, names: str, value: str, fix: str
) -> None:
    bench = Bench()
    bench.bus.close()
    monkeypatch.setattr(bench.port, "openPort", Mock(side_effect=error))
    if error is FORBIDDEN:  # then it is there
        bench.port.port_name = str(tmp_path)
    monkeypatch.setattr("os.access", lambda *_: False)
    checks = check_port(bench.bus, surroundings(tmp_path, daemon=daemon))
    *passed, last = names.split()
    assert [(check.name, check.ok) for check in checks] == [*((name, True) for name in passed), (last, False)]
    assert value in checks[-1].value
    assert fix in checks[-1].fix
    assert not bench.bus.is_open
