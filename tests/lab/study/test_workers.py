"""The same work by whoever does it: this process, spawned ones, a real Dask scheduler with two workers."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from armctl.errors import ArmctlError, RequestRefused
from armctl.lab.stage import Progress
from armctl.lab.study.workers import Workers

LOCAL = "tcp://127.0.0.1:0"


def draw(seed: int) -> tuple[int, list[float]]:
    """Which process drew, and what."""
    return os.getpid(), np.random.default_rng(seed).standard_normal(3).tolist()


def refuse(seed: int) -> int:
    if seed == 2:
        raise RequestRefused("BAD_LINE", ["too short", "too low"])
    return seed


def workers(processes: int, scheduler: str | None, told: list[float]) -> Workers:
    """Workers that note how far they are."""

    @contextmanager
    def stage(_label: str, _total: float) -> Iterator[Progress]:
        yield lambda done, _note: told.append(done)

    return Workers(stage, processes, scheduler)


def values(results: list[tuple[int, list[float]]]) -> list[list[float]]:
    return [value for _, value in results]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a Dask scheduler of its own process, with two worker processes, on the loopback only."""
    folder = tmp_path_factory.mktemp("dask")
    address_file = folder / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with ExitStack() as cleanup:

        def started(program: str, sign: str, *arguments: str) -> str:
            """The line with this sign in it, which the program says once it has started."""
            words = cleanup.enter_context((folder / f"{program}.log").open("a"))
            command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *arguments]
            process = subprocess.Popen(command, stdout=words, stderr=subprocess.PIPE, text=True, env=environment)
            cleanup.callback(process.communicate)
            cleanup.callback(process.terminate)
            assert process.stderr is not None
            for line in process.stderr:
                if sign in line:
                    return line
            raise AssertionError(f"{process.args!r} ended before it said {sign!r}")

        boss = started("dask_scheduler", "Scheduler at:", "--host", LOCAL, "--scheduler-file", str(address_file))
        address = boss.split()[-1]
        place = ("--host", "127.0.0.1", "--local-directory", str(folder))
        for _ in range(2):
            started("dask_worker", "Registered to:", address, "--nthreads", "1", "--no-nanny", *place)
        yield address


def test_here_in_spawned_processes_and_on_a_cluster_the_results_are_the_same_bits_in_order(scheduler: str) -> None:
    told: list[float] = []
    alone, spawned, cluster = (
        workers(processes, where, told).carry_out("drawing", draw, range(8))
        for processes, where in ((1, None), (2, None), (1, scheduler))
    )
    assert values(alone) == values(spawned) == values(cluster)
    assert told == 3 * list(range(1, 9))
    assert {pid for pid, _ in alone} == {os.getpid()}
    assert os.getpid() not in {pid for pid, _ in spawned}
    assert len({pid for pid, _ in cluster} - {os.getpid()}) == 2


def test_what_the_work_raises_is_raised_here_with_its_fields(scheduler: str) -> None:
    for processes, where in ((1, None), (2, None), (1, scheduler)):
        with pytest.raises(RequestRefused) as caught:
            workers(processes, where, []).carry_out("refusing", refuse, range(4))
        assert (caught.value.code, caught.value.reasons) == ("BAD_LINE", ("too short", "too low"))


def test_a_scheduler_that_is_none_is_named_with_the_remedy() -> None:
    for address in ("tcp://127.0.0.1:1", "nonsense://"):
        with pytest.raises(ArmctlError, match=r"no Dask scheduler at .*start one with"):
            workers(1, address, []).carry_out("drawing", draw, range(2))
