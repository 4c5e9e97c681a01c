"""What every test shares: an `async def test_...` runs to its end on an event loop of its own.

A fixture that is an asynchronous context is entered on that loop, and the test gets what it gives.
"""

import asyncio
import inspect
import os
from concurrent.futures import Executor
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# How long an example takes is no claim of any test: machines are slow at times. Every run has the same examples, so
# that none lands or fails by luck; `tools/test --hypothesis-profile=anew` looks for others.
settings.register_profile("the same", deadline=None, derandomize=True)
settings.register_profile("anew", deadline=None)
settings.load_profile("the same")

PROCESSORS = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def pytest_runtest_setup() -> None:
    """While tests run in real time beside these, of which a file tells, half of the processors are left to them."""
    if (beside := os.environ.get("BESIDE_REAL_TIME")) and hasattr(os, "sched_setaffinity"):
        some = PROCESSORS[len(PROCESSORS) // 2 :]
        os.sched_setaffinity(0, some if Path(beside).exists() else PROCESSORS)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = pyfuncitem.funcargs
    arguments = {name: given[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    with asyncio.Runner() as runner:
        # A fixture of this name does what the test gives to threads, in place of the loop's own pool.
        if isinstance(executor := given.get("executor"), Executor):
            runner.get_loop().set_default_executor(executor)
        runner.run(_entered(pyfuncitem.obj, arguments))
    return True


async def _entered(test: Any, arguments: dict[str, Any]) -> None:
    async with AsyncExitStack() as stack:
        for name, given in arguments.items():
            if isinstance(given, AbstractAsyncContextManager):
                arguments[name] = await stack.enter_async_context(given)
        await test(**arguments)
