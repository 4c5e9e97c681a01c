"""What may be deleted, and what never is."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from armctl.config import LogConfig
from armctl.recording.quota import KEPT, StoredLog, enforce, stored_logs, surplus

LOGS = st.lists(st.tuples(st.integers(0, 2**22), st.integers(0, 10**6)), max_size=12).map(
    lambda given: tuple(
        StoredLog(Path(f"{index}.mcap"), size, begin)
        for index, (size, begin) in enumerate(sorted(given, key=lambda one: one[1]))
    )
)


@given(LOGS, st.integers(2**20, 2**23), st.floats(0.0, 10**6), st.integers(0, 2**23), st.integers(0, 2**23))
def test_the_oldest_go_until_every_bound_holds_or_only_the_newest_are_left(
    logs: tuple[StoredLog, ...], quota_bytes: int, max_age_s: float, free_bytes: int, need_bytes: int
) -> None:
    limits = LogConfig(quota_bytes=quota_bytes, max_age_s=max_age_s, free_bytes=need_bytes)
    gone = surplus(logs, limits, free_bytes)
    left = logs[len(gone) :]
    assert gone == logs[: len(gone)]
    assert len(left) >= min(KEPT, len(logs))

    def too_much(kept: tuple[StoredLog, ...], deleted: tuple[StoredLog, ...]) -> bool:
        too_old = max_age_s > 0.0 and logs[-1].begin_s - kept[0].begin_s > max_age_s
        free = free_bytes + sum(log.size_bytes for log in deleted)
        return too_old or sum(log.size_bytes for log in kept) > quota_bytes or free < need_bytes

    if len(left) > KEPT:
        assert not too_much(left, gone)
    if gone:
        assert too_much(logs[len(gone) - 1 :], gone[:-1]), "the last one deleted had to go"


def test_logs_are_found_by_name_in_the_order_of_time(tmp_path: Path) -> None:
    names = ["armctl-20250615T150645Z.mcap", "armctl-20250615T150645Z-2.mcap", "armctl-20250615T150645Z-10.mcap"]
    others = ["fault-20250615T150645Z-HOT.mcap", "armctl-mine.mcap", "armctl-20250615T150646Z.mcap.part", "a.mcap"]
    for name in (*names, *others):
        (tmp_path / name).write_bytes(b"x" * 10)
    (tmp_path / "armctl-20240615T150645Z.mcap").symlink_to(tmp_path / "a.mcap")
    assert [log.path.name for log in stored_logs(tmp_path)] == names
    assert stored_logs(tmp_path)[0].begin_s == 1_750_000_005


def test_only_logs_are_deleted_and_the_newest_stay(tmp_path: Path) -> None:
    for second in range(5):
        (tmp_path / f"armctl-2025061{second}T150645Z.mcap").write_bytes(bytes(2**20))
    (tmp_path / "fault-20250101T000000Z-HOT.mcap").write_bytes(bytes(2**21))
    gone = enforce(tmp_path, LogConfig(quota_bytes=3 * 2**20, free_bytes=0))
    assert [path.name for path in gone] == ["armctl-20250610T150645Z.mcap", "armctl-20250611T150645Z.mcap"]
    enforce(tmp_path, LogConfig(free_bytes=2**60))
    kept = ("armctl-20250613T150645Z", "armctl-20250614T150645Z", "fault-20250101T000000Z-HOT")
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{name}.mcap" for name in kept]


def test_a_clock_that_jumps_ahead_once_deletes_nothing_but_by_age_from_the_newest_name(tmp_path: Path) -> None:
    names = [f"armctl-2025061{day}T150645Z.mcap" for day in range(4)]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    assert enforce(tmp_path, LogConfig(free_bytes=0, max_age_s=10 * 86400.0)) == ()
    gone = enforce(tmp_path, LogConfig(free_bytes=0, max_age_s=1.5 * 86400.0))
    assert [path.name for path in gone] == names[:2]
