"""What clients can ask for: parameters held to their bounds, recordings, and the one optimisation at a time."""

import asyncio
from collections.abc import Awaitable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml

from armctl.config import validate
from armctl.errors import ConfigError, LogError
from armctl.genetic.algorithm import DEFAULT, PROFILES
from armctl.genetic.straight_line import Progress
from armctl.host.jobs import OptimizeJob, RecordedRequest, optimize_task
from armctl.host.server import PERSON, Connection
from armctl.recording.recordings import Recording, describe, load
from tests.genetic import hand
from tests.host.doubles import methods_over, refused, write_take
from tests.trajectory.test_plan import make_plan


class Asker:
    """A connection as methods know it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.notified: list[tuple[str, dict[str, Any]]] = []

    def notify(self, method: str, params: dict[str, Any]) -> None:
        self.notified.append((method, params))


class Bench:
    """Methods over an arm that nobody asks, and an optimisation that waits to be told."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.jobs: list[OptimizeJob] = []
        self.gate = asyncio.Event()
        self.methods = methods_over(folder, self.optimise)
        self.table = self.methods.table()
        self.anna, self.ben = Asker("anna"), Asker("ben")

    async def optimise(self, job: OptimizeJob, progress: Progress) -> dict[str, Any]:
        self.jobs.append(job)
        progress(1, 2.0, 3.0)
        await self.gate.wait()
        return {"gap_ratio": 0.0}

    def ask(self, client: Asker, method: str, **params: Any) -> Awaitable[dict[str, Any]]:
        entry = self.table[method]
        return entry.handle(cast("Connection", client), validate(entry.params, params, method))


LINE: dict[str, Any] = {"recordings": ["a"], "from_m": [0.18, -0.125, 0.1], "to_m": [0.18, 0.125, 0.1], "via": [0]}


@pytest.fixture
def bench(taken: Path) -> Bench:
    return Bench(taken)


def test_looking_changes_nothing_and_everything_else_is_for_commanders(tmp_path: Path) -> None:
    table = Bench(tmp_path).table
    observing = {name for name, method in table.items() if method.observes}
    files = {"recordings_list", "recordings_show", "recordings_track", "plans_list", "plans_show"}
    assert observing == {"status", "log", "subscribe", *files}
    assert {name for name, method in table.items() if method.always} == {"stop", "hold", "pause"}


async def test_an_optimisation_gets_what_was_asked_for_and_tells_its_progress(bench: Bench) -> None:
    bench.gate.set()
    settings = {"generations": 50, "selection": "roulette"}
    result = await bench.ask(bench.anna, "optimize", **LINE, seed=7, duration_s=3.0, settings=settings)
    assert result == {"job": 1, "gap_ratio": 0.0}
    [job] = bench.jobs
    request = job.request
    assert job.paths == (bench.folder / "a.mcap",)
    assert (request.from_m, request.to_m) == ((0.18, -0.125, 0.1), (0.18, 0.125, 0.1))
    assert (request.via, request.seed, request.duration_s) == ((0,), 7, 3.0)
    assert (request.settings.generations, request.settings.selection) == (50, "roulette")
    assert request.settings.population == DEFAULT.population
    assert bench.anna.notified == [("progress", {"job": 1, "generation": 1, "best": 2.0, "mean": 3.0})]


async def test_one_optimisation_at_a_time(bench: Bench) -> None:
    first = asyncio.ensure_future(bench.ask(bench.anna, "optimize", **LINE))
    while not bench.jobs:
        await asyncio.sleep(0)
    with refused("BUSY", "anna"):
        await bench.ask(bench.ben, "optimize", **LINE)
    bench.gate.set()
    await first
    assert (await bench.ask(bench.ben, "optimize", **LINE))["job"] == 2


async def test_an_optimisation_ends_with_its_client_and_with_no_other(bench: Bench) -> None:
    work = asyncio.ensure_future(bench.ask(bench.anna, "optimize", **LINE))
    while not bench.jobs:
        await asyncio.sleep(0)
    bench.methods.client_gone(cast("Connection", bench.ben))
    await asyncio.sleep(0)
    assert not work.done()
    bench.methods.client_gone(cast("Connection", bench.anna))
    with refused("CANCELLED"):
        await work


WRONG = yaml.safe_load(Path(__file__).with_name("refusals.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("method", "params", "named"), [(method, *row) for method, rows in WRONG.items() for row in rows]
)
async def test_a_wrong_parameter_is_refused_by_name(
    bench: Bench, method: str, params: dict[str, Any], named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        await bench.ask(bench.anna, method, **(LINE | params if method == "optimize" else params))


async def test_an_unknown_recording_is_answered_with_the_known_ones(bench: Bench) -> None:
    for method, params in (
        ("optimize", LINE | {"recordings": ["a", "c"]}),
        ("recordings_show", {"name": "c"}),
        ("play", {"name": "c"}),
        ("recordings_rename", {"name": "c", "to": "d"}),
        ("recordings_delete", {"name": "c"}),
    ):
        with pytest.raises(LogError, match="a, b"):
            await bench.ask(bench.anna, method, **params)


async def test_recordings_are_listed_shown_renamed_and_deleted(bench: Bench) -> None:
    listed = (await bench.ask(bench.anna, "recordings_list"))["recordings"]
    assert [entry["name"] for entry in listed] == ["a", "b"]
    for entry in listed:
        assert entry.keys() >= {"name", "path", "duration_s", "samples", "mean_error_mm", "max_error_mm"}
        assert 0.0 < entry["mean_error_mm"] < entry["max_error_mm"] < 100.0
    assert await bench.ask(bench.anna, "recordings_show", name="b") == listed[1] | {"marks": []}
    ends = {"from_m": LINE["from_m"], "to_m": LINE["to_m"]}
    against = await bench.ask(bench.anna, "recordings_show", name="b", **ends)
    assert against["mean_error_mm"] != listed[1]["mean_error_mm"]
    assert 0.0 < against["mean_error_mm"] < against["max_error_mm"] < 100.0
    with pytest.raises(LogError):
        await bench.ask(bench.anna, "recordings_rename", name="a", to="b")
    renamed = await bench.ask(bench.anna, "recordings_rename", name="a", to="z")
    assert renamed == {"name": "z", "path": str(bench.folder / "z.mcap")}
    await bench.ask(bench.anna, "recordings_delete", name="b")
    assert [path.name for path in bench.folder.glob("*.mcap")] == ["z.mcap"]


async def test_a_take_is_as_far_off_a_line_wherever_that_is_told(bench: Bench) -> None:
    """However long the hand dwells at its ends: `optimize` throws the time away, and so does who shows one take."""
    ends = {"from_m": tuple(LINE["from_m"]), "to_m": tuple(LINE["to_m"])}
    shown = await bench.ask(bench.anna, "recordings_show", name="a", **ends)
    asked = {"recordings": ("a",), "via": (0,), "settings": PROFILES["paper"], "duration_s": 5.0, **ends}
    request = validate(RecordedRequest, asked, "optimize")
    job = OptimizeJob(hand.arm(), (bench.folder / "a.mcap",), request)
    [baseline] = optimize_task(job, lambda *_: None)["baseline"]
    for key in ("mean_error_mm", "max_error_mm"):
        assert shown[key] == pytest.approx(baseline[key], rel=0.01)
    elsewhere = {"from_m": (0.18, -0.125, 0.2), "to_m": (0.18, 0.125, 0.2)}  # it does not lead along that
    assert (await bench.ask(bench.anna, "recordings_show", name="a", **elsewhere))["mean_error_mm"] > 50.0


async def test_a_recording_s_path_is_told_for_drawing(bench: Bench) -> None:
    track = await bench.ask(bench.anna, "recordings_track", name="a")
    loaded = load(bench.folder / "a.mcap")
    assert track["time_s"] == loaded.time_s.tolist()
    assert np.shape(track["tool_m"]) == (loaded.samples, 3)
    assert np.shape(track["positions_rad"]) == loaded.positions_rad.shape


async def test_plans_are_kept_listed_shown_and_deleted_by_the_daemon(bench: Bench) -> None:
    plan = make_plan().model_dump(mode="json")
    assert await bench.ask(bench.anna, "plans_save", name="p", plan=plan) == {"name": "p"}
    with refused("EXISTS"):
        await bench.ask(bench.anna, "plans_save", name="p", plan=plan)
    assert [one["name"] for one in (await bench.ask(bench.anna, "plans_list"))["plans"]] == ["p"]
    shown = await bench.ask(bench.anna, "plans_show", name="p")
    assert shown["plan"] == plan
    assert np.shape(shown["tool_m"]) == (201, 3)
    await bench.ask(bench.anna, "plans_delete", name="p")
    with refused("NO_PLAN"):
        await bench.ask(bench.anna, "plans_show", name="p")


async def test_the_log_names_the_person_for_whom_a_client_asks(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[dict[str, Any]] = []
    monkeypatch.setattr(bench.methods._host, "note", notes.append)
    PERSON.set("ada")
    await bench.ask(bench.anna, "recordings_delete", name="a")
    assert notes == [
        {"request": "recordings_delete", "who": "anna", "person": "ada", "params": {"name": "a"}, "outcome": "ok"}
    ]


def test_a_recording_that_never_moved_has_no_error_to_show(tmp_path: Path) -> None:
    samples = np.repeat(hand.recordings(1, seed=1)[0][:1], 5, axis=0)
    write_take(tmp_path / "still.mcap", samples, hand.arm())
    recording: Recording = load(tmp_path / "still.mcap")
    described = describe(recording, hand.robot())
    assert described["samples"] == 5
    assert described["mean_error_mm"] is described["max_error_mm"] is None
