"""How long a virtual machine stood still."""

from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armctl.clock import RESOLVED_TICKS, MonotonicClock, Stalls
from tests.stalled import OWN, TICK_NS, Machine

RUN = st.tuples(st.integers(0, 40), st.sampled_from([(0,), (1,), (0, 1), ()]))


@given(st.lists(RUN, max_size=12))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_longest_stall_of_a_processor_is_told_and_nothing_below_what_is_resolved(
    tmp_path: Path, runs: list[tuple[int, tuple[int, ...]]]
) -> None:
    machine = Machine(tmp_path)
    lost = [0, 0]
    for ticks, processors in runs:
        machine.run(ticks, processors)
        lost = [ticks_lost + ticks * (index not in processors) for index, ticks_lost in enumerate(lost)]
        assert machine.stalls.since_ns() == (max(lost) * TICK_NS if max(lost) > RESOLVED_TICKS else 0)
    machine.stalls.begin()
    assert machine.stalls.since_ns() == 0


def test_a_machine_of_its_own_has_no_stalls(tmp_path: Path) -> None:
    machine = Machine(tmp_path, flags=OWN)
    machine.run(100, ())
    assert machine.stalls.since_ns() == 0
    assert Stalls(proc=tmp_path / "none").since_ns() == 0


def test_the_kernel_s_own_rows_are_understood(tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("flags : hypervisor lm\n")
    (tmp_path / "stat").write_bytes(Path("/proc/stat").read_bytes())
    stalls = Stalls(proc=tmp_path)
    rows = [line for line in (tmp_path / "stat").read_text().splitlines() if line.startswith("cpu")]
    assert len(stalls._count()) == len(rows) - 1


def test_nobody_stands_still_for_longer_than_time_has_passed() -> None:
    clock = MonotonicClock()
    begin_ns = clock.now_ns()
    told_ns = Stalls().since_ns()
    assert told_ns <= clock.now_ns() - begin_ns
