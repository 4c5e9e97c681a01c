"""The power-cut proof's short form, and that the proof would notice."""

import random
from collections.abc import Iterator
from io import BufferedWriter
from pathlib import Path

import pytest

from armctl.recording import quota, reader
from armctl.recording import recorder as recorder_module
from armctl.recording.disk import Disk
from armctl.recording.rotation import Files
from proving import powercut, retention
from proving.cut_disk import CutDisk, Operation, leave


def test_40_power_cuts_lose_no_more_than_a_second_and_no_finished_take() -> None:
    tally = powercut.cut(seed=1, shard=0, runs=40)
    assert tally.examples == []
    assert (tally.runs, tally.violations) == (40, 0)
    assert 0.3 < tally.worst_loss_s <= 1.0
    assert tally.recoveries_cut > 3


def test_every_40th_operation_failing_is_survived_and_told() -> None:
    tally = powercut.fail(seed=1, first=7, stride=40)
    assert tally.examples == []
    assert tally.violations == 0
    assert tally.faults_told > 0.4 * tally.faults > 5


def test_a_seed_repeats_its_story_and_its_cuts() -> None:
    story = powercut.told_story(1)
    powercut.told_story.cache_clear()
    again = powercut.told_story(1)
    assert story.operations == again.operations
    assert story.truth == again.truth
    assert {one.kind for one in story.operations} >= {"create", "write", "sync", "sync_folder", "link", "replace"}
    assert len(story.takes) == 2


def told(stories: int) -> retention.Tally:
    """What these many stories of clocks and folders find together, with a 2000th of the summary's bytes each."""
    tally = retention.Tally()
    for number in range(stories):
        one = retention.tell(1, number, 2000)
        tally.add_findings(one)
        tally.deleted += one.deleted
    return tally


def test_10_stories_of_clocks_and_folders_delete_no_new_log_before_an_old_one_and_complete_is_true() -> None:
    tally = told(10)
    assert tally.examples == []
    assert tally.violations == 0
    assert tally.deleted > 20


def test_the_proof_notices_logs_that_are_ordered_by_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quota, "_order", lambda log: log.begin_s)
    assert "which is older" in told(5).examples[0]


def test_the_proof_notices_logs_that_go_without_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quota, "surplus", lambda logs, *_: logs[:-2])
    assert any("nothing had to" in text for text in told(2).examples)


def test_the_proof_notices_a_folder_that_vanishes_unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retention, "TROUBLES", ("vanish",))
    assert told(4).violations == 0
    monkeypatch.setattr(Files, "_watch_files", lambda _: None)
    assert any("the newest log ends with" in text for text in told(4).examples)


def test_the_proof_notices_logs_that_are_called_complete_and_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_stock_reads", lambda *_: True)
    retention.spoil(random.Random(1), tmp_path, tally := retention.Tally(), 0, 50)
    assert any("complete: True" in text for text in tally.examples)


@pytest.fixture
def fresh() -> Iterator[None]:
    powercut.told_story.cache_clear()
    yield
    powercut.told_story.cache_clear()


@pytest.mark.usefixtures("fresh")
def test_the_proof_notices_a_recorder_that_flushes_too_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "FLUSH_NS", 2 * 10**9)
    tally = powercut.cut(seed=1, shard=0, runs=40)
    assert tally.violations > 0
    assert "s lost" in tally.examples[0]


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("method", ["sync", "sync_folder"])
def test_the_proof_notices_what_is_never_synced(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    def forget(disk: CutDisk, what: BufferedWriter | Path) -> None:
        if isinstance(what, BufferedWriter):
            what.flush()

    monkeypatch.setattr(CutDisk, method, forget)
    assert powercut.cut(seed=1, shard=0, runs=40).violations > 0


@pytest.mark.usefixtures("fresh")
def test_the_proof_notices_a_name_removed_before_the_new_one_is_on_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(disk: Disk, old: Path, new: Path) -> None:
        disk.link(old, new)
        disk.remove(old)
        disk.sync_folder(new.parent)

    monkeypatch.setattr(Disk, "name", careless)
    assert powercut.cut(seed=1, shard=1, runs=80, after_kinds=("remove",)).violations > 0


def test_a_cut_keeps_what_was_synced_and_may_lose_or_keep_the_rest(tmp_path: Path) -> None:
    operations = [
        Operation("create", 0, number=1, new="logs/a"),
        Operation("write", 0, number=1, data=b"A" * 600),
        Operation("sync", 0, number=1),
        Operation("sync_folder", 0, new="logs"),
        Operation("write", 0, number=1, offset=600, data=b"B" * 1000),
        Operation("create", 0, number=2, new="logs/b"),
        Operation("replace", 0, old="logs/a", new="logs/c"),
    ]
    names, lengths = set(), set()
    for seed in range(200):
        root = tmp_path / str(seed)
        leave(operations, random.Random(seed), root)
        left = {path.name for path in (root / "logs").iterdir()}
        names.add(frozenset(left))
        (kept,) = (root / "logs" / name for name in left if name != "b")
        data = kept.read_bytes()
        assert data.startswith(b"A" * 600)
        lengths.add(len(data))
    assert names == {frozenset(one) for one in ({"a"}, {"c"}, {"a", "b"}, {"b", "c"})}
    assert min(lengths) < 640
    assert max(lengths) == 1600
