"""What may be deleted, and what never is."""

import os
import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.clock import NS_PER_S
from armctl.config import LogConfig
from armctl.recording import quota
from armctl.recording.quota import KEPT, Retention, Stock, StoredLog, ages_s, stock, surplus

LOGS = st.lists(st.tuples(st.integers(0, 2**22), st.integers(0, 10**6)), max_size=12).map(
    lambda given: tuple(
        StoredLog(Path(), f"{index}.mcap", size, begin, index) for index, (size, begin) in enumerate(given, 1)
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
        too_old = ages_s(kept, max_age_s)[0] > max_age_s > 0.0
        free = free_bytes + sum(log.size_bytes for log in deleted)
        return too_old or sum(log.size_bytes for log in kept) > quota_bytes or free < need_bytes

    if len(left) > KEPT:
        assert not too_much(left, gone)
    if gone:
        assert too_much(logs[len(gone) - 1 :], gone[:-1]), "the last one deleted had to go"


@given(st.lists(st.integers(0, 2**32), min_size=1, max_size=12), st.floats(1.0, 10**6))
def test_a_step_of_the_clock_makes_no_log_old(stamps: list[int], max_age_s: float) -> None:
    logs = [StoredLog(Path(), "a", 0, begin_s, number) for number, begin_s in enumerate(stamps, 1)]
    ages = ages_s(logs, max_age_s)
    assert ages == sorted(ages, reverse=True)
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    assert ages[0] == sum(step for step in steps if 0 < step <= max_age_s)
    honest = [StoredLog(Path(), "a", 0, 60 * number, number) for number in range(len(stamps))]
    assert ages_s(honest, 60.0)[0] == 60.0 * (len(stamps) - 1)


def deleted(folder: Path, **limits: Any) -> list[str]:
    """Names of what has to go, and is gone then."""
    gone = Retention(folder, LogConfig(**{"free_bytes": 0} | limits), lambda: 0).enforce()
    assert not any(path.exists() for path in gone)
    return [path.name for path in gone]


def named(number: int, stamp: str = "20250615T150645", kind: str = "armctl") -> str:
    return f"{kind}-{stamp}Z-{number:06d}.mcap"


def test_logs_are_found_by_name_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    stamp = "armctl-20250615T150645Z"
    old = [f"{stamp}.mcap", f"{stamp}-2.mcap", f"{stamp}-10.mcap", "armctl-20380101T000000Z.mcap"]
    new = [named(1, "20370101T000000"), named(2, "19700101T000000"), named(10, "99999999T999999")]
    snapshots = ["fault-20250615T150645Z-HOT.mcap", "fault-20250615T150645Z-OTHER_WRITER-000012.mcap"]
    for name in (*old, *new, *snapshots, "armctl-mine.mcap", f"{stamp}-9.mcap.part", "a.mcap"):
        (tmp_path / name).write_bytes(b"x" * 10)
    (tmp_path / "armctl-20240615T150645Z.mcap").symlink_to(tmp_path / "a.mcap")
    (tmp_path / f"{named(31)}.part").write_bytes(b"x" * 100)
    (tmp_path / f"{named(7)}.part.broken").write_bytes(b"x" * 1000)
    found = stock(tmp_path)
    assert [log.path.name for log in found.logs] == [*old, *new]
    assert [log.path.name for log in found.snapshots] == snapshots
    assert (found.part_bytes, found.number) == (10 + 100 + 1000, 31)
    assert found.logs[0].begin_s == 1_750_000_005


def test_the_oldest_logs_go_and_the_newest_stay(tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / named(number, f"2037061{5 - number}T150645")).write_bytes(bytes(2**20))
    (tmp_path / "fault-20250101T000000Z-HOT.mcap").write_bytes(bytes(2**21))
    assert deleted(tmp_path, quota_bytes=3 * 2**20) == [named(0, "20370615T150645"), named(1, "20370614T150645")]
    (tmp_path / f"{named(9)}.part").write_bytes(bytes(2**20))
    assert deleted(tmp_path, quota_bytes=3 * 2**20) == [named(2, "20370613T150645")], "parts count"
    assert deleted(tmp_path, free_bytes=2**60) == []
    assert (tmp_path / "fault-20250101T000000Z-HOT.mcap").exists()


def test_snapshots_have_a_bound_of_their_own(tmp_path: Path) -> None:
    names = [f"fault-20250615T150645Z-HOT-{number:06d}.mcap" for number in range(5)]
    for name in names:
        (tmp_path / name).write_bytes(bytes(2**20))
    assert deleted(tmp_path, snapshots_bytes=3 * 2**20) == names[:2]
    assert deleted(tmp_path, snapshots_bytes=2**20) == names[2:3]


def test_age_is_counted_to_the_newest_name_and_a_clock_that_jumps_deletes_nothing(tmp_path: Path) -> None:
    names = [named(day, f"2025061{day}T150645") for day in range(4)]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    assert deleted(tmp_path, max_age_s=10 * 86400.0) == []
    (tmp_path / named(4, "20370615T150645")).write_bytes(b"x")
    (tmp_path / named(5, "19700615T150645")).write_bytes(b"x")
    assert deleted(tmp_path, max_age_s=10 * 86400.0) == []
    assert deleted(tmp_path, max_age_s=1.5 * 86400.0) == names[:2]


def test_the_folder_is_read_when_it_has_changed_and_once_a_minute_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns, read = [0], list[Path]()

    def noted(folder: Path, before: Stock) -> Stock:
        read.append(folder)
        return stock(folder, before)

    monkeypatch.setattr(quota, "stock", noted)
    retention = Retention(tmp_path, LogConfig(free_bytes=0), lambda: now_ns[0])
    for second in range(1000):
        now_ns[0] = second * NS_PER_S
        if second % 2:
            (tmp_path / f"{second}").touch()
            os.utime(tmp_path, ns=(second, second))
        retention.enforce()
    assert 1000 // 61 <= len(read) <= 1 + 1000 // 60
    del read[:]
    now_ns[0] += 3600 * NS_PER_S
    for _ in range(100):
        retention.enforce()
    assert len(read) <= 1
    assert [retention.next_number() for _ in range(3)] == [1, 2, 3]
    tmp_path.rename(tmp_path.with_name("away"))
    tmp_path.mkdir()
    (tmp_path / named(700)).touch()
    assert retention.next_number() == 701, "another folder of that name is read at once"


def test_of_a_folder_that_was_read_before_the_same_is_found_and_sizes_are_asked_anew_before_anything_goes(
    tmp_path: Path,
) -> None:
    rng, before = random.Random(1), Stock()
    for number in range(200):
        for chosen in rng.sample(sorted(tmp_path.iterdir()), min(3, number)):
            if rng.random() < 0.5:
                chosen.unlink()
            else:  # as one that is compacted
                (tmp_path / "new").write_bytes(bytes(rng.randrange(1000)))
                (tmp_path / "new").replace(chosen)
        for name in (named(number), named(number, kind="fault"), f"{named(number)}.part"):
            (tmp_path / name).write_bytes(bytes(rng.randrange(1000)))
        after = stock(tmp_path, before)
        assert after == stock(tmp_path)
        before = after
    assert min(len(before.logs), len(before.snapshots)) > 20
    shrunk = before.logs[5].path
    shrunk.write_bytes(bytes(2**20))
    assert stock(tmp_path, before) == before, "the sizes of finished logs are not asked again"
    now_ns = 0
    retention = Retention(tmp_path, LogConfig(free_bytes=0, quota_bytes=3 * 2**19), lambda: now_ns)
    assert retention.enforce() == ()
    shrunk.write_bytes(b"")
    assert retention.enforce(2**20) == (), "by the sizes of before the oldest would go"
    assert retention.enforce(3 * 2**19)[0] == before.logs[0].path
