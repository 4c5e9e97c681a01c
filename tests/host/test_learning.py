"""The daemon learns the arm's lag from the motions that it makes anyway."""

import asyncio
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from armctl.commissioning import sag_file
from armctl.config import Config
from armctl.files import load_arm
from armctl.host.learning import Learner
from armctl.host.methods import Methods
from armctl.host.motions import move
from armctl.host.watch import Done
from armctl.kinematics.chain import tool_position
from armctl.messages import Grip, LagModel, Mode, TickRecord, UseModel
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory import learning
from armctl.trajectory.target import MoveRequest
from proving.hosted_arm import Inline
from tests.control.ideal_arm import PERIOD_S
from tests.host.doubles import NamedClient
from tests.host.simulated import SimulatedBench

ARM = load_arm("ax12-line")
MOTIONS = 10


def own_arm(folder: Path) -> Config:
    """An arm of one's own, whose file lies in the folder."""
    file = folder / "mine.yaml"
    if not file.exists():
        file.write_text(Path("calibration/ax12-line.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    return Config(arm=str(file), data_dir=str(folder))


class Watched(SimulatedBench):
    """An arm drawn at random, whose daemon learns; it looks at the true tool while the arm moves."""

    def __init__(self, folder: Path, seed: int, spec: ArmSpec = RANDOM_SPEC) -> None:
        super().__init__(ARM, seed)
        self.simulated = SimulatedArm(ARM, seed=seed, spec=spec)
        self.virtual = VirtualArm(self.simulated, PERIOD_S)
        self.virtual.start()
        self.loop = self.virtual.loop
        self.learner = Learner(own_arm(folder), ARM, self.robot, PERIOD_S)
        host_of(self)
        self.rng = np.random.default_rng(seed)
        self.wanted: list[tuple[float, ...]] = []
        self.true_m: list[Any] = []
        self.on_tick = self._look

    def _look(self, record: TickRecord) -> None:
        self.wanted.append(record.outputs.wanted_rad)
        self.true_m.append(self.simulated.true_tool_position())

    async def holding(self) -> Self:
        asyncio.get_running_loop().set_default_executor(Inline())
        return await super().holding()

    async def some_motion(self) -> dict[str, Any]:
        """To a place drawn at random, where the arm is not too heavy."""
        self.wanted, self.true_m = [], []
        while True:
            try:
                there = self.rng.uniform((0.12, -0.2, 0.05), (0.26, 0.2, 0.3))
                asked = MoveRequest(point_m=tuple(there.tolist()))
                return await self.served(move(self.host, self.anna, asked))
            except Exception as error:
                if getattr(error, "code", "") not in ("UNREACHABLE", "PREFLIGHT", "LIMIT"):
                    raise

    def off_path_mm(self) -> float:
        """How far the true tool was from the commanded path while the arm moved, in the mean."""
        chain = self.robot.chain
        q = np.array(self.wanted[:-1])[:, : chain.n]
        moving = np.flatnonzero(np.abs(np.diff(q, axis=0)).max(axis=1) > 1e-9)
        path = tool_position(chain, q[moving[0] : moving[-1] + 2])
        fine = np.concatenate([a + np.linspace(0.0, 1.0, 20)[:, None] * (b - a) for a, b in pairwise(path)])
        true = np.array(self.true_m)[moving[0] : moving[-1] + 2]
        return 1e3 * float(np.linalg.norm(true[:, None] - fine, axis=-1).min(axis=1).mean())


def host_of(bench: Watched) -> None:
    """The host of a bench learns."""
    bench.host._load_model, bench.host._learn = bench.learner.load, bench.learner.learn
    bench.host._clock = bench.virtual.clock


async def eleventh_mm(folder: Path, seed: int) -> tuple[list[float], Watched]:
    """How far off its path each of ten ordinary motions and the eleventh was, of a fresh arm."""
    folder.mkdir(exist_ok=True)
    bench = await Watched(folder, seed).holding()
    off = []
    for _ in range(MOTIONS + 1):
        await bench.some_motion()
        off.append(bench.off_path_mm())
    return off, bench


@pytest.mark.parametrize("seed", [0, 1])
async def test_after_ten_motions_the_eleventh_stays_on_its_path(tmp_path: Path, seed: int) -> None:
    off, bench = await eleventh_mm(tmp_path, seed)
    assert off[-1] < 2.0
    told = [command for record in bench.recorder.records for command in record.inputs.commands]
    used = [command.model for command in told if isinstance(command, UseModel)]
    assert used
    assert used[0].lines == learning.FEWEST
    assert bench.host.notice == ""
    found = json.loads(sag_file.path_of(own_arm(tmp_path)).read_text(encoding="utf-8"))
    assert found["arm_id"] == ARM.arm_id
    unused = bench.learner.load() != used[-1]
    assert found["version"] == len(used) + unused, "what the last motion taught is used by the next one"
    assert found["made"].startswith("20")


async def test_the_same_motions_teach_the_same_model(tmp_path: Path) -> None:
    found = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        bench = await Watched(tmp_path / name, 2).holding()
        for _ in range(learning.FEWEST):
            await bench.some_motion()
        found.append(bench.learner.load())
    assert found[0] is not None
    assert found[0] == found[1]


async def test_a_motion_that_was_stopped_or_gripped_or_not_corrected_teaches_nothing(tmp_path: Path) -> None:
    bench = await Watched(tmp_path, 0).holding()
    task = asyncio.ensure_future(move(bench.host, bench.anna, MoveRequest(point_m=(0.2, 0.0, 0.2))))
    await bench.until(lambda: bench.loop.state.mode is Mode.MOVING)
    await bench.served(bench.host.stop())
    await bench.refused(task, "STOPPED")
    assert not sag_file.history_path(own_arm(tmp_path)).exists()
    seen: list[Done] = []
    bench.host._learn = lambda done: seen.extend(done) or ""  # type: ignore[func-returns-value]
    await bench.some_motion()
    [done] = seen
    gripping = done._replace(trajectory=replace(done.trajectory, grip=Grip(5, 0.5)))
    assert bench.learner.learn([gripping]) == ""
    assert not sag_file.history_path(own_arm(tmp_path)).exists()
    done.watch.wanted_rad[20], wanted = (), done.watch.wanted_rad[20]
    assert bench.learner.learn([done]) == ""
    assert not sag_file.history_path(own_arm(tmp_path)).exists()
    done.watch.wanted_rad[20] = wanted
    uncorrected = done._replace(trajectory=replace(done.trajectory, corrected=False))
    assert bench.learner.learn([uncorrected]) == ""
    assert not sag_file.history_path(own_arm(tmp_path)).exists(), "its joints were not where they were wanted"
    assert bench.learner.learn([done]) == ""
    assert sag_file.history_path(own_arm(tmp_path)).exists()


async def test_a_changed_arm_is_told_in_the_answer_and_learnt_anew(tmp_path: Path) -> None:
    _, bench = await eleventh_mm(tmp_path, 0)
    before = bench.learner.load()
    worn = replace(RANDOM_SPEC, friction_Nm=(2.0 * RANDOM_SPEC.friction_Nm[0], 2.0 * RANDOM_SPEC.friction_Nm[1]))
    bench = await Watched(tmp_path, 0, worn).holding()
    table = Methods(bench.host, tmp_path, None).table()  # type: ignore[arg-type]
    answer = await bench.served(table["move"].handle(bench.anna, MoveRequest(point_m=(0.2, 0.1, 0.2))))  # type: ignore[arg-type]
    assert "the arm is not as its model says" in answer["notice"]
    assert "calibrate --sag" in answer["notice"]
    assert any('"MODEL"' in note for note in bench.recorder.notes)
    assert bench.learner.load() == before, "one motion overturns no model"
    for _ in range(learning.FEWEST + 1):
        await bench.some_motion()
    after = bench.learner.load()
    assert after is not None
    assert before is not None
    friction = [rows[len(rows) - 3] for model in (before, after) for rows in model.rows[1:4]]
    assert sum(friction[3:]) > 1.4 * sum(friction[:3])


@pytest.mark.parametrize("seed", [0, 1, 2])
async def test_a_tool_150_g_heavier_than_its_model_knows_is_told_by_the_second_motion(
    tmp_path: Path, seed: int
) -> None:
    await eleventh_mm(tmp_path, seed)
    heavier = replace(RANDOM_SPEC, tool_kg=(RANDOM_SPEC.tool_kg[0] + 0.15, RANDOM_SPEC.tool_kg[1] + 0.15))
    bench = await Watched(tmp_path, seed, heavier).holding()
    for _ in range(learning.STRANGE):
        await bench.some_motion()
    assert "the arm is not as its model says" in bench.host.notice


def telling(bench: SimulatedBench, *notices: str) -> None:
    """Each motion's learning has one of these to tell."""
    left = list(notices)
    bench.host._learn = lambda _: left.pop(0)


async def test_what_is_not_as_the_model_says_is_told_to_every_client_until_it_is_dismissed(tmp_path: Path) -> None:
    bench = await Watched(tmp_path, 0).holding()
    telling(bench, "", "the arm is not as its model says", "")
    table = Methods(bench.host, tmp_path, None).table()  # type: ignore[arg-type]

    async def told(client: NamedClient) -> object:
        answer = await bench.served(table["move"].handle(client, MoveRequest(point_m=(0.2, 0.1, 0.2))))  # type: ignore[arg-type]
        return answer.get("notice")

    assert await told(bench.anna) is None
    assert bench.host.status()["notice"] is None
    for client in (bench.anna, bench.ben):
        assert await told(client) == "the arm is not as its model says"
        assert bench.host.status()["notice"] == "the arm is not as its model says"
    await bench.served(bench.host.command(bench.ben, "clear"))
    assert bench.host.status()["notice"] is None


async def test_a_new_model_ends_what_was_told_of_the_one_before(tmp_path: Path) -> None:
    bench = await Watched(tmp_path, 0).holding()
    for friction_rad, expected in ((0.01, "changed"), (0.01, "changed"), (0.02, None)):
        telling(bench, "changed" if friction_rad == 0.01 else "")
        rows = tuple((0.0,) * 5 + (friction_rad, 0.0, 0.0) for _ in range(bench.robot.chain.n))
        model = LagModel(ARM.arm_id, ARM.calibration_hash, rows, (1.0,) * len(rows), 8)
        bench.host._load_model = lambda model=model: model  # type: ignore[misc]
        await bench.some_motion()
        assert bench.host.status()["notice"] == expected


@pytest.mark.parametrize("arm", ["ax12-line", "calibration/ax12-line.yaml"])
def test_an_arm_that_comes_with_armctl_is_learnt_in_the_data_folder(tmp_path: Path, arm: str) -> None:
    config = Config(arm=arm, data_dir=str(tmp_path))
    assert sag_file.path_of(config) == tmp_path / "sag" / "ax12-line.sag.json"
    assert sag_file.history_path(config) == tmp_path / "sag" / "ax12-line.sag-history.json"


async def test_a_folder_that_cannot_be_written_stops_no_motion(tmp_path: Path) -> None:
    bench = await Watched(tmp_path, 0).holding()
    sag_file.history_path(own_arm(tmp_path)).mkdir()
    assert (await bench.some_motion())["position_error_mm"] < 5.0


async def test_a_defect_in_learning_is_logged_and_the_motion_is_answered(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = await Watched(tmp_path, 0).holding()

    def broken(*_: object) -> None:
        raise ValueError("sums of nothing")

    monkeypatch.setattr(learning, "sums_of", broken)
    assert (await bench.some_motion())["position_error_mm"] < 5.0
    assert "sums of nothing" in caplog.text
