"""The whole job on simulated servos: teach, optimise, run with 0, 1 and 2 via points, learn, run again, refine, report.

The first runs are plain: goals are the plan's own positions, and the arm sags. They show how each joint lags behind its
goal. That model is stored beside the arm's file, and the same plans run again, corrected by it in the control step.
What has via points goes on with runs that correct the plan, as `armctl run --refine` does.

Everything happens as on a real arm: the simulator is a program behind a pseudo terminal, the daemon owns that port,
and what follows are requests on its socket. Only two things come from the simulator beside the wire: the hand that
guides the limp arm, and the true tool pose, by which straightness is judged. The simulator runs in lockstep with the
daemon's ticks, so the same seed gives the same recordings and with them the same result of the optimiser.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.commissioning import sag_file
from armctl.commissioning.arm_file import whole_text
from armctl.config import ArmConfig, Config
from armctl.errors import ArmctlError, ConfigError, RequestRefused, UnreachableTarget
from armctl.files import load_arm, read_text
from armctl.genetic.algorithm import DEFAULT
from armctl.json_text import named
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.lab import sag_identification
from armctl.lab.line_experiment import TAKES
from armctl.lab.line_results import line_run
from armctl.lab.rig import DaemonRig, measured_run
from armctl.lab.stage import Progress, Stage
from armctl.lab.table_ii import VIA
from armctl.recording import recordings, replay
from armctl.report import line
from armctl.report.line import Goals
from armctl.sim.arm import SimulatedArm
from armctl.sim.control import SimulatorClient, control_path
from armctl.trajectory.plan import Plan, plan_from_text
from armctl.trajectory.refinement import Measured, waited_long
from armctl.trajectory.straightness import errors_mm, own_chord_mm

# Lines that the hand may take [m], the first one in reach: how far ahead, how far to each side, how high.
LINES = ((0.18, 0.125, 0.10), (0.18, 0.125, 0.25), (0.14, 0.08, 0.15), (0.14, 0.08, 0.25), (0.10, 0.05, 0.12))
DURATION_S = 5.0
START_TIMEOUT_S = 20.0
STOP_TIMEOUT_S = 5.0
GOALS: tuple[Goals, ...] = get_args(Goals)
# Further runs of a plan at most, which correct it.
REFINE = 2
Ends = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass
class _Session:
    """The running programs, and where they write."""

    client: Client
    watcher: Iterator[dict[str, Any]]
    simulator: SimulatorClient
    stage: Stage
    # Of the line [m].
    ends_m: Ends

    def wait_ticks(self, end: int, show: Progress = lambda _done, _note: None, note: str = "", begin: int = 0) -> None:
        """Let the daemon's ticks from `begin` up to `end` pass.

        Raises:
            ArmctlError: the daemon latched a fault meanwhile.
        """
        for passed in range(begin, end):
            fault = next(self.watcher)["fault"]
            if fault is not None:
                raise ArmctlError(f"{fault['code']}: {fault['text']}")
            show(passed + 1, note)


@dataclass(frozen=True, eq=False)
class _Ran:
    """One run of a plan: what the daemon answered, and what was measured, where the tool really was included."""

    plan: Plan
    goals: Goals
    answer: dict[str, Any]
    measured: Measured


def run(out: Path, seed: int, stage: Stage, arm_name: str = "ax12-line") -> dict[str, Any]:
    """Run the demonstration into `out`; an earlier one there is moved aside, not overwritten.

    Args:
        arm_name: Name or file of the arm to simulate.
    Returns:
        The JSON of `armctl demo`.
    Raises:
        ArmctlError: some part failed; the messages of the programs are in `out`/daemon.log and simulator.log.
        ConfigError: there is no such arm, or no line of `LINES` is in its reach.
    """
    arm = load_arm(arm_name)
    if (ends_m := line_in_reach(arm, range(seed * 1000, seed * 1000 + TAKES))) is None:
        remedy = "`armctl try` takes it, and `armctl hand` any line"
        raise ConfigError(arm_name, "", "none of the demonstration's lines is in this arm's reach", remedy)
    own_arm = out / f"{arm.arm_id}.yaml"
    with ExitStack() as cleanup:
        sockets = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="armctl-")))
        port, socket = sockets / "servos", sockets / "daemon.sock"
        with stage("starting", 2) as show:
            start(cleanup, arm_name, own_arm, port, socket, show, "--seed", str(seed), "--lockstep")
        session = _Session(
            client=cleanup.enter_context(Client(socket)),
            watcher=cleanup.enter_context(Client(socket)).subscribe(),
            simulator=cleanup.enter_context(SimulatorClient(control_path(port))),
            stage=stage,
            ends_m=ends_m,
        )
        names = _teach(session, seed)
        optimised = _optimise(session, names, seed)
        plans = [plan_from_text(plan["text"], f"plan with {plan['via']} via points") for plan in optimised["plans"]]
        for plan in optimised["plans"]:
            (out / f"plan-via{plan['via']}.json").write_text(plan["text"], encoding="utf-8")
        runs = [run for plan in plans for run in _run(session, out, plan, corrected=False)]
        _learn(DaemonRig(session.client, arm), Config(arm=str(own_arm)), runs, stage)
        runs += [run for plan in plans for run in _run(session, out, plan, corrected=True)]
    runs.sort(key=lambda ran: GOALS.index(ran.goals))
    return _finish(session, out, arm, names, optimised, runs)


def _teach(session: _Session, seed: int) -> list[str]:
    """Record the candidates: the simulator's hand guides the limp arm."""
    client, period_s = session.client, next(session.watcher)["period_s"]
    session.wait_ticks(5)
    client.call("teach_begin", confirm=True)
    session.wait_ticks(2)
    names = [f"candidate-{take}" for take in range(1, TAKES + 1)]
    for take, name in enumerate(names):
        guided = session.simulator.guide(*session.ends_m, seed=seed * 1000 + take)
        at_A, at_B = round((guided.begin_s - 0.3) / period_s), round((guided.end_s + 0.8) / period_s)
        with session.stage(f"teaching {take + 1} of {TAKES}", at_B + 5) as show:
            session.wait_ticks(at_A, show, "to the start")
            client.call("take_begin", name=name)
            session.wait_ticks(at_B, show, "along the line", begin=at_A)
            client.call("take_end")
            session.wait_ticks(5)
            show(at_B + 5, "")
    client.call("teach_end")
    client.call("torque_on")
    session.simulator.let_go()
    return names


def _optimise(session: _Session, names: list[str], seed: int) -> dict[str, Any]:
    asked = {"from_m": session.ends_m[0], "to_m": session.ends_m[1], "via": VIA, "duration_s": DURATION_S}
    with session.stage("optimising", DEFAULT.generations) as show:

        def tell(told: dict[str, Any]) -> None:
            show(told["generation"] + 1, f"{told['best']:.3f} mm")

        return session.client.call("optimize", on_progress=tell, recordings=names, seed=seed, **asked)


def _run(session: _Session, out: Path, plan: Plan, *, corrected: bool) -> list[_Ran]:
    """A run of a plan; a corrected one with via points is also refined: its first run, and its best.

    Where a busy machine disturbed every run of a refinement, nothing is refined.
    """
    how, refine = GOALS[corrected], REFINE if corrected and plan.via else 0
    with session.stage(f"running via {plan.via}, {how}", 1 + refine) as show:
        asked = partial(session.client.call, "run", plan=plan.model_dump(mode="json"), corrected=corrected)
        try:
            answer = asked(refine=refine, on_progress=lambda told: show(told.get("runs", 0), ""))
        except RequestRefused as refused:
            if refused.code != "DISTURBED":
                raise
            answer, refine = asked(), 0
        show(1 + refine, f"{answer['mean_error_mm']:.1f} mm by encoders")
    best = _ran(session, out, plan, how, answer)
    if not refine:
        return [best]
    row = answer["rounds"][0]
    first, last = (_recording(out, name) for name in (row["recordings"][0], answer["recording"]))
    earlier_ns = _begin_ns(last) - _begin_ns(first)
    times_ns = {key: answer[key] - earlier_ns for key in ("begin_ns", "end_ns")}
    return [
        _ran(session, out, plan, how, {**answer, **row, **times_ns, "recording": first.name}),
        replace(best, plan=plan_from_text(read_text(Path(answer["plan"]), "plan"), answer["plan"]), goals="refined"),
    ]


def _begin_ns(run: recordings.Recording) -> int:
    """When the plan of a recorded run began, on the recorder's clock."""
    assert run.plan_s is not None
    return run.start_ns + round(run.plan_s[0] * NS_PER_S)


def _ran(session: _Session, out: Path, plan: Plan, goals: Goals, answer: dict[str, Any]) -> _Ran:
    truth = session.simulator.truth(answer["begin_ns"], answer["end_ns"])
    if len(truth.time_ns) < 2:
        raise RequestRefused("SIMULATOR", "the simulator kept no truth of this run")
    seen = measured_run(_recording(out, answer["recording"]), answer["duration_s"])
    true_time_s = (truth.time_ns - answer["begin_ns"]) / NS_PER_S
    return _Ran(plan, goals, answer, seen._replace(true_time_s=true_time_s, true_tool_m=truth.tool_m))


def _learn(rig: DaemonRig, config: Config, runs: list[_Ran], stage: Stage) -> None:
    """Store how the arm lagged in its plain runs beside its file, from where the daemon takes it before the next run.

    A run in which the arm waited long says nothing of its lag; with none left the daemon goes on foreseeing the lag of
    a new arm.
    """
    with stage("learning how it lags", 1) as show:
        timely = (r for r in runs if not waited_long(r.plan.duration_s, r.measured.duration_s, rig.period_s))
        seen = [(r.plan, r.measured) for r in timely]
        if seen:
            sag_file.save(config, sag_identification.learnt(rig, seen))
        show(1, f"from {len(seen)} runs")


def _recording(out: Path, name: str) -> recordings.Recording:
    return recordings.load(out / "recordings" / f"{name}.mcap")


def _finish(
    session: _Session, out: Path, arm: ArmConfig, names: list[str], optimised: dict[str, Any], runs: list[_Ran]
) -> dict[str, Any]:
    """Replay every log, write the report, and say it all."""
    logs = sorted((out / "logs").glob("*.mcap")) + sorted((out / "recordings").glob("*.mcap"))
    replayed = {"ticks": 0, "messages": 0, "mismatches": 0, "seconds": 0.0}
    with session.stage("replaying every log", len(logs)) as show:
        for count, log in enumerate(logs):
            result = replay.check(log)
            for key in replayed:
                replayed[key] += getattr(result, key)
            show(count + 1, f"{count + 1} of {len(logs)}")
    counted = "{ticks} ticks, {messages} messages, {mismatches} mismatches."
    chain = robots.of(arm).chain
    takes = [_recording(out, name).positions_rad for name in names]
    report = line.LineReport(
        ends=(np.array(session.ends_m[0]), np.array(session.ends_m[1])),
        joint_names=arm.joint_names,
        candidates_m=[tool_position(chain, q[:, : chain.n]) for q in takes],
        candidate_errors_mm=[*map(itemgetter("name", "mean_error_mm", "max_error_mm", "genes"), optimised["baseline"])],
        ga_mean_mm=optimised["ga"]["mean_error_mm"],
        exact_mean_mm=optimised["exact"]["mean_error_mm"],
        gap_ratio=optimised["gap_ratio"],
        best_mm=np.array(optimised["history"]["best_cost_mm"]),
        mean_mm=np.array(optimised["history"]["mean_cost_mm"]),
        runs=[line_run(chain, ran.plan.via, ran.plan, ran.measured)._replace(goals=ran.goals) for ran in runs],
        notes=("Every log was run through the control step again: " + counted.format_map(replayed),),
    )
    with session.stage("writing the report", 1) as show:
        line.write(report, out / "report.html")
        show(1, "")
    refined = [ran for ran in runs if ran.goals == "refined"]
    return {
        "rows": [_row(ran) for ran in runs],
        "refined": [{**_row(ran), "rounds": ran.answer["rounds"], "plan": ran.answer["plan"]} for ran in refined],
        **{who: {key: value for key, value in optimised[who].items() if key != "tool_m"} for who in ("ga", "exact")},
        **{key: optimised[key] for key in ("gap_ratio", "baseline")},
        "logs": [str(log) for log in logs],
        "plan": str(out / f"plan-via{VIA[-1]}.json"),
        "report": str(out / "report.html"),
        "replay": replayed,
    }


def _row(ran: _Ran) -> dict[str, Any]:
    plan, tool_m = ran.plan, ran.measured.true_tool_m
    assert tool_m is not None
    mean_mm, max_mm = errors_mm(tool_m, np.array(plan.from_m), np.array(plan.to_m))
    return {
        "via": plan.via,
        "corrected": ran.goals != "plain",
        "goals": ran.goals,
        **{key: ran.answer[key] for key in ("mean_error_mm", "max_error_mm", "duration_s")},
        **named(plan, "predicted_mean_error_mm", "predicted_max_error_mm"),
        "truth": {"mean_error_mm": mean_mm, "max_error_mm": max_mm},
        "own_chord": dict(zip(("mean_error_mm", "max_error_mm"), own_chord_mm(tool_m), strict=True)),
        "recording": ran.answer["recording"],
    }


def line_in_reach(arm: ArmConfig, seeds: Iterable[int] = (0,)) -> Ends | None:
    """The first of `LINES` along which the hand can lead the arm, in each of these takes; None: it can along none."""
    hand = SimulatedArm(arm).hand
    for ahead, aside, high in LINES:
        A, B = (ahead, -aside, high), (ahead, aside, high)
        with suppress(UnreachableTarget):
            for seed in seeds:
                hand.guide(np.array(A), np.array(B), seed=seed)
            return A, B
    return None


def start(
    cleanup: ExitStack, arm: str, own_arm: Path, port: Path, socket: Path, show: Progress, *options: str
) -> tuple[str, ...]:
    """Start simulated servos and their daemon in an empty folder; how to tell others of them. `cleanup` ends them.

    `own_arm` becomes an arm's file of its own there, so that what is learnt stays; `options` are those of `armctl sim`.
    """
    folder, config = own_arm.parent, own_arm.with_name("armctl.yaml")
    make_room(folder)
    own_arm.write_text(whole_text(arm), encoding="utf-8")
    told = {"arm": str(own_arm), "port": str(port), "data_dir": str(folder)}
    config.write_text(yaml.safe_dump(told), encoding="utf-8")
    common, servos = ("--config", str(config), "--socket", str(socket)), ("--arm", str(own_arm), "--link", str(port))
    cleanup.enter_context(started(folder / "simulator.log", "sim", *servos, *options))
    show(1, "simulated servos")
    cleanup.enter_context(started(folder / "daemon.log", "daemon", *common))
    show(2, "daemon")
    return common


@contextmanager
def started(log: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start an armctl program and wait until it says `ready`, and what is; it is ended on leaving.

    It has a session of its own. Linux delays the bytes of a terminal if busy processes share the session: by up to
    0.24 s with four of them, and by 0.03 s where they have another session.

    Args:
        log: Where its messages go.
    Raises:
        ArmctlError: it did not start; its last message is in the error.
    """
    command = [sys.executable, "-m", "armctl", *arguments]
    with (
        log.open("a", encoding="utf-8") as words,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=words, text=True, start_new_session=True) as process,
    ):
        assert process.stdout is not None
        try:
            ready, _, what = process.stdout.readline().strip().partition(" ")
            if ready != "ready":
                process.wait(START_TIMEOUT_S)
                lines = log.read_text(encoding="utf-8").splitlines()
                told = [line.removeprefix("armctl: ") for line in lines if line and not line.startswith("  next: ")]
                raise ArmctlError(f"armctl {arguments[0]} did not start: {told[-1] if told else 'no word'}")
            yield process, what
        finally:
            process.terminate()
            try:
                process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def make_room(out: Path) -> None:
    """Make `out` an empty folder: what was left there before is moved into a folder of its own."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        old = [path for path in out.iterdir() if not path.name.startswith("earlier-")]
        if old:
            aside = out / f"earlier-{datetime.now(UTC):%Y%m%dT%H%M%S}"
            aside.mkdir()
            for path in old:
                path.rename(aside / path.name)
    except OSError as error:
        raise ArmctlError(f"{out}: cannot write there: {error.strerror}; choose another folder") from None
