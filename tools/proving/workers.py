"""Many trials, in this process or in several, and how long they will still take."""

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

WORKERS = 2

Job = TypeVar("Job")
Found = TypeVar("Found")


def carry_out(
    run: Callable[[Job], Found], jobs: Sequence[Job], tell: Callable[[str], None], workers: int = WORKERS
) -> list[Found]:
    """What became of every job, in order; one worker: in this process."""
    began_s, done = time.monotonic(), []

    def count(result: Found) -> None:
        done.append(result)
        left_s = (time.monotonic() - began_s) / len(done) * (len(jobs) - len(done))
        tell(f"{len(done)} of {len(jobs)} trials, about {left_s:.0f} s left")

    if workers == 1:
        for job in jobs:
            count(run(job))
        return done
    # The workers' own threads would only fight over the processors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(run, jobs):
            count(result)
    return done
