"""Who does the work of a study: this process, spawned processes, or a Dask cluster.

A piece of work is a plain function at the top of a module, and one argument that holds everything, the seed included.
Nothing is shared. So the results are the same bits whoever does the work; they come in the order of the arguments.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

from armctl.errors import ArmctlError
from armctl.host.jobs import NICENESS
from armctl.lab.stage import Stage
from armctl.recording.export import extra

A = TypeVar("A")
R = TypeVar("R")

CONNECT_S = 5


class Workers(NamedTuple):
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
        with self.stage(label, len(arguments)) as show, self._mapped(len(arguments)) as mapped:
            results: list[R] = []
            for result in mapped(work, arguments):
                results.append(result)
                show(len(results), f"{len(results)} of {len(arguments)}")
            return results

    @contextmanager
    def _mapped(self, pieces: int) -> Iterator[Callable[..., Iterator[Any]]]:
        """What does as `map` does: this process, spawned ones, or a cluster as if it were some."""
        processes = min(self.processes, pieces)
        if self.scheduler is None and processes <= 1:
            yield map
            return
        if self.scheduler is None:
            with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), os.nice, (NICENESS,)) as pool:
                try:
                    yield pool.map
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise
            return
        distributed = extra("Dask schedulers", "distributed", "study")
        try:
            client = distributed.Client(self.scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            remedy = (
                "start one with `dask scheduler` and workers with `dask worker`, with armctl installed where they run"
            )
            raise ArmctlError(
                f"no Dask scheduler at {self.scheduler}: {error or type(error).__name__}; {remedy}"
            ) from None
        with client:
            yield client.get_executor(pure=False).map
