"""The fuzz proof's short form, that its texts are what they claim, and that its judges would notice."""

import asyncio
import json
import multiprocessing
import random
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import validate
from armctl.errors import RequestRefused
from armctl.host import jsonrpc
from armctl.host.jsonrpc import MAX_LINE_BYTES, RequestId
from armctl.host.server import Method
from proving.fuzz import daemon, files, malformed, requests, tally
from proving.fuzz.http import http_requests
from proving.fuzz.tally import Tally

ARM = requests.fuzzed_arm()
VALID = requests.requests_to(ARM)


@given(st.integers(0, 2**32))
@settings(max_examples=200)
def test_a_request_is_one_line_and_the_same_generator_says_the_same(seed: int) -> None:
    line = malformed.request_line(random.Random(seed), VALID, 7)
    assert b"\n" not in line
    assert len(line) < MAX_LINE_BYTES
    assert malformed.request_line(random.Random(seed), VALID, 7) == line


@given(st.integers(0, 2**32))
@settings(max_examples=100)
def test_a_change_leaves_what_it_began_with(seed: int) -> None:
    rng = random.Random(seed)
    tree = {"a": [1, {"b": 2.0}], "c": "d"}
    malformed.changed(rng, tree)
    assert tree == {"a": [1, {"b": 2.0}], "c": "d"}


def test_lines_are_of_every_kind() -> None:
    """Valid ones and broken ones, duplicate keys, depth, halves of surrogate pairs, and no end of digits."""
    rng = random.Random(1)
    lines = [malformed.request_line(rng, VALID, number) for number in range(3000)]
    problems, methods = [], set()
    for line in lines:
        try:
            methods.add(jsonrpc.decode(line).method)
        except jsonrpc.ProtocolError as error:
            problems.append(error.problem)
    told = "\n".join(problems)
    for expected in ("stands twice", "nested more than 16", "surrogate", "not a finite", "utf-8", "unknown key"):
        assert expected in told
    assert {method for method, _ in VALID} <= methods
    assert 300 < len(problems) < 2000


def test_every_method_is_asked_with_parameters_that_it_takes(tmp_path: Path) -> None:
    async def table() -> Mapping[str, Method]:
        async with daemon.served(1, tmp_path) as rig:
            return rig.methods

    methods = asyncio.run(table())
    assert {method for method, _ in VALID} == set(methods)
    for method, params in VALID:
        validate(methods[method].params, json.loads(json.dumps(params)), method)


def test_requests_in_process_short(tmp_path: Path) -> None:
    found = Tally()
    asyncio.run(daemon.in_process(3, 1500, found, tmp_path))
    assert (found.violations, found.examples) == (0, [])
    assert found.runs == 1500
    assert found.outcomes["done"] > 100
    assert found.outcomes["CONFIG"] > 100


def test_configurations_short() -> None:
    # In a process of its own, since its memory and processor time are judged: this one has those of other tests.
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(_configurations, 1, 150).result()
    assert (found.violations, found.examples, found.runs) == (0, [], 150)
    assert found.outcomes["read"] > 5
    assert found.outcomes["refused"] > 50


def _configurations(seed: int, count: int) -> Tally:
    found = Tally()
    files.yaml_files(seed, count, found)
    return found


def test_names_short(tmp_path: Path) -> None:
    found = Tally()
    files.recording_names(1, 1000, found, tmp_path)
    assert (found.violations, found.examples, found.runs) == (0, [], 1000)
    assert found.outcomes["find: done"] > 0


@pytest.mark.pty
def test_a_daemon_and_its_dashboard_short(tmp_path: Path) -> None:
    found = Tally()
    for name in ("socket", "http"):
        (tmp_path / name).mkdir()
    daemon.on_socket(1, 200, found, tmp_path / "socket")
    http_requests(1, 1, found, tmp_path / "http")
    assert (found.violations, found.examples) == (0, [])
    assert found.runs > 250
    assert found.outcomes["done"] > 0
    assert found.outcomes["422"] > 0


def answer(request_id: RequestId = 1, **parts: object) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "id": request_id, **parts}).encode()


def test_results_and_declared_errors_are_fit() -> None:
    assert requests.unfit(answer(result={})) == ""
    assert requests.unfit(jsonrpc.error_line(None, RequestRefused("BUSY", "wait"))) == ""
    assert requests.unfit(jsonrpc.error_line(1, jsonrpc.ProtocolError(jsonrpc.PARSE_ERROR, "no"))) == ""


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"{",
        answer(),
        answer(result=[]),
        answer(result={}, error={}),
        answer(error={"code": -32000, "data": {"code": "X", "reasons": [], "exit_status": 1}}),
        answer(error={"code": -32000, "data": {"code": "X", "reasons": ["a"], "exit_status": 9}}),
        answer(error={"code": -5, "data": {"code": "X", "reasons": ["a"], "exit_status": 1}}),
        jsonrpc.error_line(1, ZeroDivisionError()),
    ],
)
def test_anything_else_is_not(line: bytes) -> None:
    assert requests.unfit(line) != ""


def test_what_takes_too_long_is_a_violation() -> None:
    found = Tally()
    found.took(tally.HANG_S - 0.1, "quick")
    assert found.violations == 0
    found.took(tally.HANG_S + 0.1, "slow")
    assert (found.violations, found.examples) == (1, ["1.10 s for slow"])


def test_what_lies_outside_of_the_folder_is_a_violation(tmp_path: Path) -> None:
    files.recording_names(1, 1, Tally(), tmp_path)
    found = Tally()
    files._untouched(tmp_path, tmp_path / "in", found)
    assert found.violations == 0
    (tmp_path / "escaped.mcap").touch()
    (tmp_path / "in" / "a\n.mcap").touch()
    files._untouched(tmp_path, tmp_path / "in", found)
    assert found.violations == 2
