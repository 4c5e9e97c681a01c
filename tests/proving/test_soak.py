"""The soak's parts: stories, shrinking, one episode, a short run as a command."""

import json
import math
import multiprocessing
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
from click.testing import CliRunner

from armctl.control.machine import State
from armctl.control.step import step
from armctl.messages import Event, Inputs, Mode, Outputs, SetRate, TickRecord
from armctl.sim.faults import Fault
from proving import __main__ as proving
from proving import soak
from proving.episode import Episode, Stage, stage
from proving.evidence import Servo
from proving.invariants import Judge
from proving.meetings import Meetings, never_met, table
from proving.reading import TICK_DEG
from proving.story import (
    DAMAGES,
    HAPPENINGS,
    KINDS,
    PAIRS,
    WISHES,
    Garble,
    Kill,
    Late,
    Line,
    Story,
    Strike,
    Wish,
    Word,
    draw,
    shrink,
    thickened,
)


@pytest.fixture(scope="module")
def on() -> Stage:
    return stage()


RUN = (Wish(0.3, "run", 5), Wish(20.0, "run", 6))


def played(on: Stage, *lines: Line, duration_s: float = 30.0) -> Episode:
    """An episode with a run, and whatever else happens, played to its end."""
    episode = Episode(Story(1, duration_s, tuple(sorted((*RUN, *lines), key=lambda line: line.at_s))), on)
    outcome = episode.play()
    assert outcome.violations == []
    return episode


def test_what_an_arm_may_weigh_does_not_depend_on_what_holds_it_up(on: Stage) -> None:
    episode = Episode(Story(1, 2.0, ()), on)
    episode.play()
    strains = episode.watch.strains()  # it lies at rest
    assert not any(one.gravity for one in strains)
    assert max(abs(one.carrying or 0.0) for one in strains) > 0.3


def test_a_story_is_the_same_for_the_same_numbers_and_another_for_others(on: Stage) -> None:
    assert draw(1, 2, on.arm) == draw(1, 2, on.arm)
    assert len({draw(seed, episode, on.arm) for seed in (1, 2) for episode in (1, 2)}) == 4


def test_stories_hold_every_kind_of_fault_wish_and_word(on: Stage) -> None:
    lines = [line for episode in range(60) for line in draw(1, episode, on.arm).lines]
    assert {line.fault.kind for line in lines if isinstance(line, Strike)} == set(KINDS)
    assert {line.what for line in lines if isinstance(line, Wish)} == set(WISHES)
    lines += [line for episode in range(60) for line in thickened(draw(1, episode, on.arm), 1, episode, on.arm).lines]
    assert {line.how for line in lines if isinstance(line, Garble)} == set(DAMAGES)
    assert {type(line) for line in lines} == set(Line.__args__)
    assert all(str(line) for line in lines)


def test_every_two_happenings_are_drawn_together_in_a_hundred_and_thirty_episodes(on: Stage) -> None:
    drawn: Counter[tuple[str, str]] = Counter()
    for episode in range(130):
        story = thickened(draw(2, episode, on.arm), 2, episode, on.arm)
        meetings = Meetings(story)
        for tick in range(2500):
            meetings.tick(0.1 * tick, powered=True)
        drawn.update(meetings.met)
    assert never_met(drawn) == []
    assert len(list(table(drawn))) == len(HAPPENINGS) + 1
    assert never_met({PAIRS[0]: 1}) == [" + ".join(pair) for pair in PAIRS[1:]]


def test_shrinking_keeps_what_the_failure_needs_and_nothing_else() -> None:
    lines = tuple(Word(float(at_s), "hold", at_s) for at_s in range(1, 40))
    tried = 0

    def fails_at_s(story: Story) -> float | None:
        nonlocal tried
        tried += 1
        left = {line.at_s for line in story.lines}
        return 31.0 if {7.0, 30.0} <= left and story.duration_s > 31.0 else None

    short = shrink(Story(1, 100.0, lines), fails_at_s, budget_s=60.0)
    assert [line.at_s for line in short.lines] == [7.0, 30.0]
    assert short.duration_s == pytest.approx(31.2)
    assert tried < 60


def test_a_run_a_fault_and_its_card_lead_back_to_a_moving_arm(on: Stage) -> None:
    episode = played(on, Strike(Fault(kind="mute", servo_id=3, begin_s=4.0, duration_s=1.5)))
    assert episode.rows["SERVO_SILENT"] == 1
    told = [text for _, text in episode.told]
    assert any(text.startswith("state faulted, SERVO_SILENT") for text in told)
    assert told.index("-> clear") < len(told) - told[::-1].index("-> run") - 1


def test_a_dropped_arm_is_lifted_by_hand_and_runs_again(on: Stage) -> None:
    trip = Strike(Fault(kind="trip", servo_id=2, begin_s=6.0, duration_s=0.1))
    episode = played(on, trip, duration_s=40.0)
    assert episode.rows["TRIPPED"] == 1
    told = [text for _, text in episode.told]
    assert told.index("-> release") < told.index("-> clear")
    assert told[told.index("-> clear") :].count("-> torque_on") == 1


def test_killed_in_mid_tick_the_next_process_adopts_the_arm(on: Stage) -> None:
    episode = played(on, Kill(5.0, 3, 0.8), duration_s=12.0)
    assert (episode.rows["SIGKILL"], episode.rows["RESTARTED"]) == (1, 1)
    assert f"state {Mode.HOLDING}" in [text for at_s, text in episode.told if at_s > 5.8]


@pytest.mark.parametrize("sends", [0, 3, 7])
def test_a_death_counts_from_where_the_arm_is_then_right_behind_a_goal_too(
    on: Stage, monkeypatch: pytest.MonkeyPatch, sends: int
) -> None:
    leads_deg: list[float] = []

    def died(judge: Judge, now_s: float, servos: Sequence[Servo]) -> None:
        assert episode.body.time_s == pytest.approx(now_s, abs=0.0011)
        leads_deg.extend(abs(servo.goal - servo.shaft_tick) * TICK_DEG for servo in servos)
        judge_died(judge, now_s, servos)

    judge_died = Judge.died
    monkeypatch.setattr(Judge, "died", died)
    episode = Episode(Story(16, 12.0, (Wish(0.3, "run", 538574), Kill(8.6, sends, 0.8))), on)
    assert episode.play().violations == []
    assert max(leads_deg) > (6.0 if sends == 7 else 1.0)


@pytest.mark.parametrize(("seed", "episode"), [(301, 82), (301, 214), (301, 266)])
def test_what_a_soak_found_is_not_found_again(seed: int, episode: int) -> None:
    """Ramps taken for others where goals were lost; a push told of a joint that bears its weight at 5 V."""
    on, drawn = soak.drawn_by(seed, episode)
    assert Episode(drawn, on).play().violations == []


def test_a_late_tick_stops_the_run(on: Stage) -> None:
    assert played(on, Late(5.0, 400.0), duration_s=8.0).rows["LATE"] == 1


def test_an_episode_says_the_same_bytes_twice_and_its_inputs_repeat_the_step(on: Stage) -> None:
    story = replace(draw(1, 3, on.arm), duration_s=25.0)
    outcome = soak.play(story, on, twice=True)
    assert outcome.violations == []
    other = soak.play(replace(story, seed=story.seed + 1), on)
    assert other.wire != outcome.wire


def test_a_step_that_differs_is_noticed(on: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    def other(state: State, inputs: Inputs, *rest: Any) -> tuple[State, Outputs]:
        state, outputs = step(state, inputs, *rest)
        return state, replace(outputs, progress=0.123) if inputs.tick == 12 else outputs

    monkeypatch.setattr("proving.episode.step", other)
    found = Episode(Story(1, 3.0, RUN[:1]), on).play().violations
    assert [(v.invariant, v.text) for v in found] == [("replay", "the step, run again, differs at tick 12")]


def test_an_episodes_log_replays_and_one_that_differs_is_told(on: Stage) -> None:
    records: list[TickRecord] = []
    Episode(Story(1, 3.0, (*RUN[:1], Kill(1.0, 3, 0.4))), on, log=records.append).play()
    assert [record.inputs.tick for record in records].count(0) == 2
    wrong = replace(records[4], outputs=replace(records[4].outputs, events=(Event("info", "STATE", "no such thing"),)))
    assert mismatch(on, records) == ""
    assert mismatch(on, [*records[:4], wrong, *records[5:]]).startswith("tick 4, ")


def test_an_episodes_log_ends_where_it_could_not_be_written(on: Stage) -> None:
    records: list[TickRecord] = []
    Episode(Story(1, 2.0, RUN[:1]), on, log=records.append).play()
    nan = replace(records[8], inputs=replace(records[8].inputs, commands=(SetRate(9, math.nan),)))
    assert mismatch(on, [*records[:8], nan, *records[9:]]) == ""
    assert mismatch(on, [nan]) == ""


def mismatch(on: Stage, records: Sequence[TickRecord]) -> str:
    """What the replay of a log of these records says."""
    with soak.EpisodeLog(on) as log:
        for record in records:
            log.take(record)
        return log.mismatch()


def test_a_failing_episode_is_shrunk_and_told_with_the_command_that_repeats_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("armctl.control.sequences.SOFT_TORQUE", 700)
    told: list[str] = []
    result = soak.prove(1, episode=4, budget_s=10.0, tell=told.append)
    assert result["violations"] > 0
    assert result["repeat"] == "tools/prove soak --seed 1 --episode 4"
    assert "INVARIANT 3 BROKEN: base: torque came on with limit 700" in "\n".join(told)
    assert any(line.endswith("shrunk to 1:") for line in told)


def test_the_soak_as_a_command_gives_figures_and_rows() -> None:
    result = CliRunner().invoke(proving.main, ["prove", "soak", "--seed", "1", "--episode", "1", "--json"])
    figures = json.loads(result.stdout)
    assert result.exit_code == 0
    assert (figures["runs"], figures["violations"], figures["repeat"]) == (1, 0, "")
    assert figures["hours"] > 0.03
    assert figures["realtime_ratio"] > 1.0
    assert [row["row"] for row in figures["rows"]] == list(soak.ROWS)


def _held_and_left_mib() -> tuple[float, float]:
    before_mib = soak.memory_mib()
    parts = [b"\1" * 20_000 for _ in range(500)]
    last = b"\1" * 20_000  # behind them, so that the allocator keeps what they leave until it is asked for it
    held_mib = soak.memory_mib() - before_mib
    parts.clear()
    return held_mib, soak.memory_mib() - before_mib + 0.0 * len(last)


def test_14_memory_in_use_counts_and_what_is_given_back_does_not() -> None:
    # In a process of its own, as a soak's worker: this one has what other tests left of its memory.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        held_mib, left_mib = pool.submit(_held_and_left_mib).result()
    assert held_mib > 9.0
    assert left_mib < 0.1 * held_mib


@pytest.mark.parametrize(("grown_mib", "told"), [(2.9, False), (3.2, True)])
def test_14_a_worker_that_grows_is_told_of(grown_mib: float, told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    memory_mib = iter((80.0, 80.0 + grown_mib))
    monkeypatch.setattr(soak, "memory_mib", lambda: next(memory_mib))
    monkeypatch.setattr(soak, "_baseline", None)
    monkeypatch.setattr(soak, "_tally", tally := soak.Tally(runs=soak.WARM))
    soak._watch_process(tally, 7)
    soak._watch_process(tally, 7)
    assert [failure[:2] for failure in tally.failures] == ([(7, "14")] if told else [])


def test_a_proof_refuses_options_that_are_not_its_own() -> None:
    result = CliRunner().invoke(proving.main, ["prove", "packets", "--hours", "1"])
    assert result.exit_code == 2
    assert "packets takes no --hours" in result.stderr
