"""Who does the work of a study: this process, spawned processes, or a Dask cluster.

A piece of work is a plain function at the top of a module, and one argument that holds everything, the seed included.
Nothing is shared. So the results are the same bits whoever does the work; they come in the order of the arguments.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from armctl.errors import ArmctlError
from armctl.host.jobs import NICENESS
from armctl.lab.stage import Stage
from armctl.recording.export import extra

A = TypeVar("A")
R = TypeVar("R")

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

            if self.scheduler is None and min(self.processes, len(arguments)) <= 1:
                results = []
                for argument in arguments:
                    results.append(work(argument))
                    tell(len(results))
                return results
            with self._pool(len(arguments)) as pool:
                futures = [pool.submit(work, argument) for argument in arguments]
                try:
                    for done, future in enumerate(as_completed(futures), 1):
                        future.result()  # raises what the work raised, without waiting for the rest
                        tell(done)
                except BaseException:
                    for future in futures:
                        future.cancel()
                    pool.shutdown(wait=False)
                    raise
                return [future.result() for future in futures]

    @contextmanager
    def _pool(self, pieces: int) -> Iterator[Executor]:
        """Spawned processes, or the cluster as if it were some."""
        if self.scheduler is None:
            processes = min(self.processes, pieces)
            with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), os.nice, (NICENESS,)) as pool:
                yield pool
            return
        distributed = extra("Dask schedulers", "distributed", "study")
        try:
            client = distributed.Client(self.scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ArmctlError(
                f"no Dask scheduler at {self.scheduler}: {error or type(error).__name__}; start one with `dask "
                "scheduler` and workers with `dask worker`, with armctl installed where they run"
            ) from None
        with client:
            yield client.get_executor(pure=False)
