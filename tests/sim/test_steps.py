"""The joint's steps as machine code: the same to the last bit."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.sim import steps


@pytest.fixture(scope="module")
def plain() -> ModuleType:
    """The module as Python runs it, whatever has been compiled in this process."""
    spec = importlib.util.find_spec("armctl.sim.steps")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@settings(deadline=None, max_examples=300)
@given(
    state=st.tuples(number(1.0, 4.0), number(-0.004, 0.004), st.sampled_from([0.0, 0.0, 0.3, -1.5])),
    count=st.integers(1, 40),
    ramp=st.tuples(number(400.0, 600.0), st.integers(400, 600), st.sampled_from([0.01, 0.5, 4.0])),
    load=number(-1.0, 1.0),
    ends=st.sampled_from([(-9.0, 9.0), (0.0, 5.2), (2.58, 2.62)]),
    motor=st.sampled_from([(0.0, 0.0), (1.5, 0.26), (1.3, 0.3)]),
    frozen_tick=st.sampled_from([-1, -1, -1, 500]),
    mode=st.sampled_from([(False, False), (True, False), (True, False), (True, True)]),
    pull=st.none() | st.tuples(number(1.0, 4.0), number(-1.0, 1.0), st.integers(-1, 19)),
)
def test_machine_code_gives_the_same_bits(
    plain: ModuleType,
    state: tuple[float, float, float],
    count: int,
    ramp: tuple[float, int, float],
    load: float,
    ends: tuple[float, float],
    motor: tuple[float, float],
    frozen_tick: int,
    mode: tuple[bool, bool],
    pull: tuple[float, float, int] | None,
) -> None:
    assert steps.compiled(), "numba is missing; the extra `fast` brings it"
    shaft, off, omega = state
    start, goal, way = ramp
    arrival = 0 if start == goal else int(abs(goal - start) / way) + 1
    arguments = (
        *(shaft, shaft + off, omega, 0, count),
        *(start, float(goal), way if goal > start else -way, arrival),
        *(load, 1e-3 / 0.01, 0.1, 0.12, 0.005, *ends, *motor, 0.02, 1e-4, frozen_tick),
        *(*mode, 0.3, 0.8, 32 / 1023, 1, 2, 0.03, 0.06),
        *(pull is not None, *(pull or (0.0, 0.0, 0))),
    )
    assert steps.integrate(*arguments) == plain.integrate(*arguments)


@given(number(-3000.0, 3000.0))
def test_machine_code_reads_the_same_ticks(plain: ModuleType, position_tick: float) -> None:
    assert steps.compiled()
    assert steps.sensed_tick(position_tick) == plain.sensed_tick(position_tick)


def test_without_numba_it_runs_as_it_stands(plain: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    before = plain.integrate
    assert not plain.compiled()
    assert plain.integrate is before
