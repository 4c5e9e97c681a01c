"""Who does the work of a study: this process, spawned processes, or a Dask cluster.

A piece of work is a plain function at the top of a module and one argument that says everything, its seed included;
nothing is shared. So the results, which come in the order of the arguments, are the same bits whoever works.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, TypeVar

from armctl.errors import ArmctlError
from armctl.host.jobs import NICENESS

A = TypeVar("A")
R = TypeVar("R")
Tell = Callable[[int], None]
"""Called with the number of pieces done."""

CONNECT_S = 5


def carry_out(
    work: Callable[[A], R], arguments: Sequence[A], *, workers: int, scheduler: str | None, tell: Tell
) -> list[R]:
    """The result for each argument, in order.

    Args:
        workers: How many processes of this machine; 1: this one. Of no meaning with a scheduler.
        scheduler: Address of a Dask scheduler, such as tcp://host:8786.
    Raises:
        ArmctlError: what the work raised; or distributed is not installed, or no scheduler answers.
    """
    if scheduler is not None:
        return _on_cluster(work, arguments, scheduler, tell)
    if workers == 1 or len(arguments) < 2:
        results = []
        for argument in arguments:
            results.append(work(argument))
            tell(len(results))
        return results
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(arguments)), context, os.nice, (NICENESS,)) as pool:
        futures = [pool.submit(work, argument) for argument in arguments]
        try:
            _watch(as_completed(futures), lambda future: future.result(), tell)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [future.result() for future in futures]


def _watch(finished: Iterable[Any], result: Callable[[Any], object], tell: Tell) -> None:
    for done, future in enumerate(finished, 1):
        result(future)  # raises what the work raised, without waiting for the rest
        tell(done)


def _on_cluster(work: Callable[[A], R], arguments: Sequence[A], scheduler: str, tell: Tell) -> list[R]:
    with _cluster(scheduler) as client:
        from distributed import as_completed as as_gathered

        gathered: Any = as_gathered
        futures = client.map(work, list(arguments), pure=False)
        _watch(gathered(futures, loop=client.loop), lambda future: future.result(), tell)
        results: list[R] = client.gather(futures)
    return results


@contextmanager
def _cluster(scheduler: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise ArmctlError("a Dask scheduler needs distributed; install it with: pip install 'armctl[study]'") from None
    connect: Any = Client
    try:
        client = connect(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ArmctlError(
            f"no Dask scheduler at {scheduler}: {error or type(error).__name__}; start one with `dask scheduler` and "
            "workers with `dask worker`, with armctl installed where they run"
        ) from None
    with client:
        yield client
