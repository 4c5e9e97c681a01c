"""EEPROM of simulated servos: what is written, what is refused, and that nothing moves."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from armctl.commissioning import eeprom
from armctl.commissioning.eeprom import Difference
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.identify import Identification
from armctl.errors import ConfigError, PortGone, RequestRefused
from tests.commissioning.bench import Bench, unwritten
from tests.host.doubles import refused

UNSETTABLE = (ax12a.ID, ax12a.BAUD, ax12a.MODEL, ax12a.GOAL, ax12a.TORQUE_ENABLE)


@pytest.fixture(params=[0.0, 16.0], ids=["quick", "slow"])
def bench(request: pytest.FixtureRequest) -> Bench:
    return Bench(latency_ms=request.param)


def registers(bench: Bench, which: Iterable[ax12a.Register]) -> list[list[int]]:
    """What these registers of every servo hold."""
    return [[servo.get(register) for register in which] for servo in bench.servos]


def deaf(monkeypatch: pytest.MonkeyPatch, heard: Callable[[Bench], object] = lambda bench: None) -> Bench:
    """A bench where something else happens than what is written."""
    bench = Bench()
    monkeypatch.setattr(bench.bus, "write", lambda _: heard(bench))
    return bench


# ------------------------------------------------------------------------------------------------------ id and baud


def test_a_servo_gets_its_id_and_only_that(bench: Bench) -> None:
    before = registers(bench, ax12a.REGISTERS[3:18])
    eeprom.set_id(bench.bus, 4, 9)
    assert registers(bench, [ax12a.ID]) == [[1], [2], [3], [9], [5], [6]]
    assert registers(bench, ax12a.REGISTERS[3:18]) == before
    assert not any(servo.torque_enabled for servo in bench.servos)


def test_a_taken_id_is_refused_even_if_its_servo_reads_nothing(bench: Bench) -> None:
    bench.servos[4].set(ax12a.RETURN_LEVEL, 0)
    for taken in (3, 5):
        with unwritten(bench), pytest.raises(RequestRefused, match=f"servo {taken} already answers"):
            eeprom.set_id(bench.bus, 4, taken)


ATTEMPTS: tuple[Callable[[Bench, int], object], ...] = (
    lambda bench, servo_id: eeprom.set_id(bench.bus, servo_id, 50),
    lambda bench, servo_id: eeprom.set_baud(bench.bus, servo_id, 57_600),
    lambda bench, servo_id: eeprom.write_register(bench.bus, servo_id, ax12a.SHUTDOWN, 36),
)


def test_two_servos_with_one_id_are_not_written(bench: Bench) -> None:
    bench.servos[3].set(ax12a.ID, 3)
    for attempt in ATTEMPTS:
        with unwritten(bench), refused("DUPLICATE_ID", "two servos answer"):
            attempt(bench, 3)


def test_with_torque_on_or_locked_nothing_is_written(bench: Bench) -> None:
    bench.servos[0].set(ax12a.TORQUE_ENABLE, 1)
    bench.servos[1].set(ax12a.LOCK, 1)
    for servo_id, code in ((1, "TORQUE_ON"), (2, "LOCKED"), (77, "SERVO_SILENT")):
        for attempt in ATTEMPTS:
            with unwritten(bench), refused(code):
                attempt(bench, servo_id)


@pytest.mark.parametrize(
    ("attempt", "arguments", "problem"),
    [
        *((eeprom.set_id, ids, "id") for ids in ((1, 1), (1, 254), (-1, 3))),
        *((eeprom.set_baud, (1, baud), "1000000, 500000") for baud in (0, -5, 1200, 2_000_000, 700_000)),
        *((eeprom.write_register, (3, register, 1), "not set this way") for register in UNSETTABLE),
        (eeprom.write_register, (3, ax12a.RETURN_LEVEL, 3), r"outside 0\.\.2"),
    ],
)
def test_what_no_servo_has_or_nobody_may_set_is_refused(
    attempt: Callable[..., object], arguments: tuple[object, ...], problem: str
) -> None:
    bench = Bench()
    with unwritten(bench), pytest.raises(ConfigError, match=problem):
        attempt(bench.bus, *arguments)


def test_twins_that_read_alike_are_told_after_the_fact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only one of two servos hears the write: the old id still answers."""
    bench = deaf(monkeypatch, lambda bench: bench.servos[2].set(ax12a.ID, 9))
    bench.servos[3].set(ax12a.ID, 3)
    monkeypatch.setattr(eeprom, "answers_twice", lambda *_: False)
    monkeypatch.setattr(eeprom, "read_table", lambda *_: bytes(26))
    with pytest.raises(RequestRefused, match="there were two of them"):
        eeprom.set_id(bench.bus, 3, 9)


REAL = {57_600: 57_142, 115_200: 117_647, 9_600: 9_615, 1_000_000: 1_000_000}


@pytest.mark.parametrize(("baud", "real"), REAL.items())
def test_a_servo_is_found_again_at_its_new_baud(bench: Bench, baud: int, real: int) -> None:
    assert eeprom.set_baud(bench.bus, 2, baud) == real
    assert (bench.port.baudrate, bench.bus.read(2, ax12a.MODEL)) == (baud, 12)
    assert round(bench.servos[1].baud) == pytest.approx(real, abs=1)


def test_a_baud_at_which_the_id_is_taken_is_refused(bench: Bench) -> None:
    bench.servos[1].set(ax12a.BAUD, 34)
    bench.servos[1].set(ax12a.ID, 1)
    with pytest.raises(RequestRefused, match="another servo 1 answers at 57600"):
        eeprom.set_baud(bench.bus, 1, 57_600)
    assert (bench.port.baudrate, bench.servos[0].get(ax12a.BAUD)) == (1_000_000, 1)


@pytest.mark.parametrize(
    ("attempt", "baud_rate", "text"),
    [
        (lambda bus: eeprom.set_id(bus, 4, 9), 1, "does not answer as 9"),
        (lambda bus: eeprom.set_baud(bus, 1, 57_600), 1, "still answers at 1000000"),
        (lambda bus: eeprom.set_baud(bus, 1, 57_600), 9, "scan --baud all"),
        (lambda bus: eeprom.write_register(bus, 1, ax12a.RETURN_DELAY, 0), 1, "time was to be 0 and reads 250"),
    ],
    ids=["id", "baud", "another baud", "register"],
)  # fmt: skip
def test_what_is_not_taken_over_is_told(
    monkeypatch: pytest.MonkeyPatch, attempt: Callable[[ServoBus], object], baud_rate: int, text: str
) -> None:
    bench = deaf(monkeypatch, lambda bench: bench.servos[0].set(ax12a.BAUD, baud_rate))
    with refused("NOT_WRITTEN", text):
        attempt(bench.bus)
    assert bench.port.baudrate == 1_000_000


# ---------------------------------------------------------------------------------------------------- registers


def test_a_register_is_written_and_read_back(bench: Bench) -> None:
    eeprom.write_register(bench.bus, 3, ax12a.CCW_LIMIT, 900)
    assert bench.servos[2].get(ax12a.CCW_LIMIT) == 900


@pytest.mark.parametrize("level", [0, 1])
def test_a_mute_servo_gets_its_return_level_back(bench: Bench, level: int) -> None:
    bench.servos[2].set(ax12a.RETURN_LEVEL, level)
    eeprom.write_register(bench.bus, 3, ax12a.RETURN_LEVEL, 2)
    assert bench.servos[2].get(ax12a.RETURN_LEVEL) == 2


def test_a_port_that_vanishes_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = deaf(monkeypatch, lambda bench: bench.port.unplug())
    for match in ("return_delay_time was to be 0", "the port vanished; plug"):  # after the write, and before it
        with pytest.raises(PortGone, match=match):
            eeprom.write_register(bench.bus, 1, ax12a.RETURN_DELAY, 0)


# -------------------------------------------------------------------------------------------- save, diff, restore


@pytest.mark.parametrize("name", ["e.yaml", "e.json"])
def test_what_was_saved_is_restored(bench: Bench, tmp_path: Path, name: str) -> None:
    saved = eeprom.save(bench.bus, bench.config.servo_ids, tmp_path / name)
    assert eeprom.load(tmp_path / name) == saved
    assert eeprom.differences(bench.bus, saved) == []
    bench.servos[2].set(ax12a.SHUTDOWN, 4)
    bench.servos[5].set(ax12a.CW_LIMIT, 100)
    wanted = [Difference(3, "shutdown", 36, 4), Difference(6, "cw_angle_limit", 18, 100)]
    assert eeprom.differences(bench.bus, saved) == wanted
    only_third, rest, none = (eeprom.restore(bench.bus, saved, only) for only in ((3,), (), ()))
    assert (only_third, rest, none) == (wanted[:1], wanted[1:], [])
    assert not any(servo.torque_enabled for servo in bench.servos)


def test_a_file_is_never_overwritten(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "e.yaml"
    path.write_text("precious")
    with pytest.raises(RequestRefused, match="not overwritten"):
        eeprom.save(bench.bus, (1,), path)
    assert path.read_text() == "precious"
    with pytest.raises(ConfigError, match="cannot be written"):
        eeprom.save(bench.bus, (1,), path / "x.yaml")


def test_a_silent_servo_is_a_difference_and_not_saved(bench: Bench, tmp_path: Path) -> None:
    saved = eeprom.save(bench.bus, (1, 2), tmp_path / "e.yaml")
    bench.servos[1].set(ax12a.ID, 9)
    found = eeprom.differences(bench.bus, saved)
    assert {(difference.servo_id, difference.found) for difference in found} == {(2, None)}
    with pytest.raises(RequestRefused, match="servo 2: cannot be read"):
        eeprom.save(bench.bus, (1, 2), tmp_path / "f.yaml")
    assert not (tmp_path / "f.yaml").exists()


def test_restoring_names_every_obstacle_and_writes_nothing(bench: Bench, tmp_path: Path) -> None:
    saved = eeprom.save(bench.bus, bench.config.servo_ids, tmp_path / "e.yaml")
    for servo in bench.servos:
        servo.set(ax12a.RETURN_DELAY, 0)
    bench.servos[1].set(ax12a.TORQUE_ENABLE, 1)
    bench.servos[3].set(ax12a.MODEL, 18)
    bench.servos[4].set(ax12a.ID, 99)
    *others, sixth = saved.servos
    slow = sixth.model_copy(update={"registers": {**sixth.registers, "baud_rate": 3}})
    other_baud = saved.model_copy(update={"servos": (*others, slow)})
    with unwritten(bench), pytest.raises(RequestRefused) as refusal:
        eeprom.restore(bench.bus, other_baud)
    assert [reason.split(":")[0] for reason in refusal.value.reasons] == [f"servo {i}" for i in (2, 4, 5, 6)]
    with pytest.raises(ConfigError, match="it holds 1, 2, 3, 4, 5, 6"):
        eeprom.restore(bench.bus, saved, (7,))


WRONG = {ax12a.CW_LIMIT: 0, ax12a.CCW_LIMIT: 1023, ax12a.SHUTDOWN: 1, ax12a.TEMPERATURE_LIMIT: 150}


def test_what_identify_refuses_is_mended_and_nothing_else_is_written(bench: Bench) -> None:
    joints = bench.config.joints
    fit = registers(bench, eeprom.EEPROM_REGISTERS)
    with unwritten(bench):
        assert eeprom.mend(bench.bus, joints) == []
    for register, value in WRONG.items():
        bench.servos[3].set(register, value)
    assert ("EEPROM_MISMATCH", 4) in {
        (problem.code, problem.servo_id) for problem in Identification(bench.bus, joints, "").advance() or ()
    }
    done = eeprom.mend(bench.bus, joints[3:4])
    assert {(it.register, it.found) for it in done} == {(register.name, value) for register, value in WRONG.items()}
    assert bench.servos[3].get(ax12a.SHUTDOWN) == 37
    bench.servos[3].set(ax12a.SHUTDOWN, 36)
    bench.servos[3].set(ax12a.TEMPERATURE_LIMIT, 70)
    assert registers(bench, eeprom.EEPROM_REGISTERS) == fit
    assert not any(
        problem.code == "EEPROM_MISMATCH" for problem in Identification(bench.bus, joints, "").advance() or ()
    )


def test_no_servo_is_mended_while_one_of_them_must_not_be_written(bench: Bench) -> None:
    bench.servos[0].set(ax12a.SHUTDOWN, 0)
    bench.servos[5].set(ax12a.TORQUE_ENABLE, 1)
    with unwritten(bench), pytest.raises(RequestRefused, match="servo 6: torque is on"):
        eeprom.mend(bench.bus, bench.config.joints)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("servos: []", "at least 1"),
        ("servos: [{servo_id: 1, registers: {colour: 1}}]", "no EEPROM register 'colour'"),
        ("servos: [{servo_id: 1, registers: {shutdown: 300}}]", r"outside 0\.\.127"),
        ("servos: [{servo_id: 1, registers: {id: 2}}]", "is not servo_id 1"),
        ("servos: [{servo_id: 1, registers: {}}, {servo_id: 1, registers: {}}]", "stands here twice"),
        ("servos: [{servo_id: 254, registers: {}}]", "253"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "e.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem):
        eeprom.load(path)
