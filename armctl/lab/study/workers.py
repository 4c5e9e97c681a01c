"""Who does the work of a study: this process, spawned processes, or a Dask cluster.

A piece of work is a plain function at the top of a module, and one argument that holds everything, the seed included.
Nothing is shared. So the results are the same bits whoever does the work; they come in the order of the arguments.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar

from armctl.errors import ArmctlError
from armctl.host.jobs import NICENESS
from armctl.kinematics.transform import FloatArray
from armctl.lab.line_experiment import guided_takes
from armctl.lab.stage import Stage
from armctl.lab.study.case import Case

A = TypeVar("A")
R = TypeVar("R")
# Called with the number of pieces done.
Tell = Callable[[int], None]

CONNECT_S = 5


@dataclass(frozen=True)
class Workers:
    """Who does the work, and who is told how far it is."""

    stage: Stage
    # Of this machine; 1: this one. Of no meaning with a scheduler.
    processes: int
    # Address of a Dask scheduler, such as tcp://host:8786.
    scheduler: str | None = None

    def carry_out(self, label: str, work: Callable[[A], R], arguments: Sequence[A]) -> list[R]:
        """The result for each argument, in order.

        Raises:
            ArmctlError: what the work raised; or distributed is not installed, or no scheduler answers.
        """
        with self.stage(label, len(arguments)) as show:

            def tell(done: int) -> None:
                show(done, f"{done} of {len(arguments)}")

            if self.scheduler is not None:
                return _on_cluster(work, arguments, self.scheduler, tell)
            if self.processes > 1 and len(arguments) > 1:
                return _in_processes(work, arguments, min(self.processes, len(arguments)), tell)
            results = []
            for argument in arguments:
                results.append(work(argument))
                tell(len(results))
            return results

    def guided(self, case: Case) -> tuple[FloatArray, ...]:
        """Takes of the simulated hand along the case's line: joint positions [rad], each shape (samples, joints).

        Raises:
            UnreachableTarget: an end of the line is out of the hand's reach.
        """
        return tuple(guided_takes(case.rig(), case.line, case.seed, self.stage))


def _in_processes(work: Callable[[A], R], arguments: Sequence[A], processes: int, tell: Tell) -> list[R]:
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), os.nice, (NICENESS,)) as pool:
        futures = [pool.submit(work, argument) for argument in arguments]
        try:
            _watch(as_completed(futures), tell)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [future.result() for future in futures]


def _watch(finished: Iterable[Any], tell: Tell) -> None:
    for done, future in enumerate(finished, 1):
        future.result()  # raises what the work raised, without waiting for the rest
        tell(done)


def _on_cluster(work: Callable[[A], R], arguments: Sequence[A], scheduler: str, tell: Tell) -> list[R]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise ArmctlError("a Dask scheduler needs distributed; install it with: pip install 'armctl[study]'") from None
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ArmctlError(
            f"no Dask scheduler at {scheduler}: {error or type(error).__name__}; start one with `dask scheduler` and "
            "workers with `dask worker`, with armctl installed where they run"
        ) from None
    with client:
        futures = client.map(work, list(arguments), pure=False)
        _watch(distributed.as_completed(futures, loop=client.loop), tell)
        results: list[R] = client.gather(futures)
    return results
