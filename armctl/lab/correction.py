"""Plans run and corrected on a rig, by the rules of `trajectory/refinement.py`."""

from collections.abc import Iterable

from armctl.errors import RequestRefused
from armctl.lab.course import too_heavy
from armctl.lab.rig import Rig
from armctl.messages import LagModel
from armctl.trajectory.course import Course, plan_of
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import ASTRAY, Measured, Refinement, Round, Shown, following, with_run


def run(rig: Rig, course: Course, plan: Plan, number: int, *, corrected: bool = True) -> Round:
    """A round of one run.

    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    return with_run(rig, Round(number, course, plan, corrected), rig.run(plan, corrected=corrected))


def first_run(rig: Rig, candidates: Iterable[Course], model: LagModel | None, seed: int, *, corrected: bool) -> Round:
    """The first course whose plan may run and is not too heavy by the model, and its run.

    Raises:
        RequestRefused: none may; the reasons of the most promising.
    """
    refused: RequestRefused | None = None
    for course in candidates:
        plan = plan_of(rig, course, seed)
        if reason := too_heavy(rig, model, plan):
            refused = refused or RequestRefused("TOO_HEAVY", reason)
            continue
        try:
            return run(rig, course, plan, 0, corrected=corrected)
        except RequestRefused as refusal:
            if refusal.code not in ASTRAY:
                raise
            refused = refused or refusal
    assert refused is not None
    raise refused


def refine(rig: Rig, first: Round, rounds: int, show: Shown = lambda _: None) -> list[Round]:
    """Measure, correct and run again, at most `rounds` times. Returns `first` and the new rounds, in order.

    The last of them that is `kept` is the outcome.

    Raises:
        RequestRefused: a run was stopped.
    """
    work = Refinement(rig, first, rounds, show=show)
    steps = work.steps()
    one = following(steps)
    while one is not None:
        try:
            told: Measured | RequestRefused = rig.run(one.plan, corrected=one.corrected)
        except RequestRefused as refusal:
            told = refusal
        one = following(steps, told)
    return work.rounds
