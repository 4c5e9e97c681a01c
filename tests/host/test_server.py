"""Connections: refusals by name, floods, slow readers, gaps, and the end of a client."""

import asyncio
import errno
import json
import os
import socket
from contextlib import AbstractAsyncContextManager
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.clock import NS_PER_S
from armctl.host import jsonrpc, server
from armctl.host.allowance import BURST, COMINGS_BURST, USER_PLACES, Account
from armctl.host.server import MAX_SNAPSHOTS
from tests.host.peers import PATIENCE_S, Bench, Peer, bench, until


class Full:
    """A listening socket of a process that has as many files open as it may."""

    def __init__(self, listening: socket.socket) -> None:
        self.fileno = listening.fileno

    def accept(self) -> None:
        raise OSError(errno.EMFILE, "Too many open files")


@pytest.fixture
def b() -> AbstractAsyncContextManager[Bench]:
    return bench()


async def test_requests_are_answered_by_their_id(b: Bench) -> None:
    b.peer.send("echo", 7, number=3)
    assert await b.peer.receive() == {"jsonrpc": "2.0", "id": 7, "result": {"number": 3}}


async def test_a_long_request_does_not_hold_up_the_next_one(b: Bench) -> None:
    b.peer.send("wait", 1)
    b.peer.send("stop", 2)
    assert (await b.peer.receive())["id"] == 2
    b.gate.set()
    assert (await b.peer.receive())["id"] == 1


async def test_a_wrong_parameter_is_named_with_value_and_bound(b: Bench) -> None:
    for params, words in (
        ({"number": 11}, ("number", "11", "10")),
        ({"number": "3"}, ("number", "'3'")),
        ({"number": True}, ("number", "True")),
        ({}, ("number",)),
        ({"number": 3, "colour": 1}, ("colour", "unknown")),
    ):
        error = (await b.peer.call("echo", **params))["error"]
        assert error["code"] == jsonrpc.INVALID_PARAMS
        assert error["data"]["exit_status"] == 2
        assert error["data"]["type"] == "ConfigError"
        assert all(word in error["message"] for word in words), error["message"]


async def test_an_unknown_method_is_answered_with_the_known_ones(b: Bench) -> None:
    error = (await b.peer.call("dance"))["error"]
    assert error["code"] == jsonrpc.METHOD_NOT_FOUND
    assert "dance" in error["message"]
    assert "echo" in error["message"]


async def test_errors_keep_their_reasons_and_a_defect_ends_nothing(b: Bench) -> None:
    error = (await b.peer.call("refuse"))["error"]
    assert error["code"] == jsonrpc.ARMCTL_ERROR
    assert error["data"]["reasons"] == ["too fast", "too low"]
    assert (await b.peer.call("break"))["error"]["code"] == jsonrpc.INTERNAL_ERROR
    assert (await b.peer.call("echo", number=1))["result"] == {"number": 1}


async def test_notifications_are_carried_out_and_not_answered(b: Bench) -> None:
    b.peer.send("subscribe", None)
    b.peer.send("echo", None, number=99)
    b.peer.send("echo", 5, number=1)
    assert (await b.peer.receive())["id"] == 5
    assert len(b.seen) == 1


async def test_what_is_no_request_is_answered_and_the_next_line_is_served(b: Bench) -> None:
    b.peer.send_raw(b'{"jsonrpc":"2.0","id":1,"method":"echo","params":{"number":1e999}}\n')
    assert (await b.peer.receive())["error"]["code"] == jsonrpc.PARSE_ERROR
    assert (await b.peer.call("echo", number=1))["result"] == {"number": 1}


@pytest.mark.parametrize("ended", [True, False])
async def test_an_overlong_line_is_answered_and_the_connection_closed(b: Bench, ended: bool) -> None:
    b.peer.send_raw(b"x" * (jsonrpc.MAX_LINE_BYTES + 2) + b"\n" * ended)
    answer = await b.peer.receive()
    assert answer["error"]["code"] == jsonrpc.PARSE_ERROR
    assert "65536" in answer["error"]["message"]
    assert await b.peer.ended()
    await until(lambda: len(b.gone) == 1)


async def test_a_flood_is_refused_and_stop_is_served_to_the_flooder_and_to_others(b: Bench) -> None:
    flooder, other = b.peer, await b.connect()
    # The clock stands still: the burst and not one more.
    count = int(BURST) + 200
    for number in range(count):
        flooder.send("echo", number, number=1)
    flooder.send("stop", -1)
    await until(lambda: len(b.server._connections) == 2)
    answers = {}
    for _ in range(count + 1):
        answer = await flooder.receive()
        answers[answer["id"]] = answer
    assert "result" in answers[-1]
    # Those over the bound of requests under way at once are refused as well.
    served = sum("result" in answers[number] for number in range(count))
    assert 0 < served <= BURST
    assert {answers[n]["error"]["data"]["code"] for n in range(int(BURST), count)} == {"RATE_LIMIT"}
    assert "result" in await other.call("stop")
    assert "result" in await other.call("echo", number=1)


async def test_the_allowance_comes_back_with_time(b: Bench) -> None:
    for _ in range(int(BURST)):
        assert "result" in await b.peer.call("echo", number=1)
    assert "error" in await b.peer.call("echo", number=1)
    b.clock.advance_ns(NS_PER_S)
    assert "result" in await b.peer.call("echo", number=1)


async def test_requests_under_way_are_bounded(b: Bench) -> None:
    for number in range(server.MAX_REQUESTS + 1):
        b.peer.send("wait", number)
    answer = await b.peer.receive()
    assert answer["id"] == server.MAX_REQUESTS
    assert answer["error"]["data"]["code"] == "RATE_LIMIT"
    assert "result" in await b.peer.call("stop")
    b.gate.set()
    for _ in range(server.MAX_REQUESTS):
        assert "result" in await b.peer.receive()


async def test_snapshots_reach_subscribers_only_and_are_made_only_for_them(b: Bench) -> None:
    peer, other = b.peer, await b.connect()
    b.server.publish(lambda: pytest.fail("nobody subscribed"))
    await peer.call("subscribe")
    b.server.publish(lambda: {"tick": 1})
    assert await peer.receive() == {"jsonrpc": "2.0", "method": "snapshot", "params": {"gap": 0, "tick": 1}}
    assert (await other.call("echo", number=1))["id"] == 1


async def test_a_slow_subscriber_loses_the_oldest_and_is_told_how_many(b: Bench) -> None:
    await b.peer.call("subscribe")
    count = MAX_SNAPSHOTS + 36
    for tick in range(count):  # without a turn for the sender in between
        b.server.publish(lambda tick=tick: {"tick": tick})  # type: ignore[misc]
    received = [(await b.peer.receive())["params"] for _ in range(MAX_SNAPSHOTS)]
    assert received[0] == {"gap": 36, "tick": 36}
    assert [snapshot["gap"] for snapshot in received[1:]] == [0] * (MAX_SNAPSHOTS - 1)
    assert [snapshot["tick"] for snapshot in received] == list(range(36, count))


async def test_a_subscriber_that_takes_nothing_is_cut(b: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "STALL_S", 0.05)
    await b.peer.call("subscribe")
    b.peer.writer.transport.pause_reading()  # type: ignore[attr-defined]
    text = "x" * 100_000
    async with asyncio.timeout(PATIENCE_S):
        while not b.gone:
            b.server.publish(lambda: {"text": text})
            await asyncio.sleep(0)
    assert not b.server._connections


async def test_a_client_that_reads_no_answers_is_cut_before_they_fill_the_memory(b: Bench) -> None:
    await b.peer.call("subscribe")
    b.peer.writer.transport.pause_reading()  # type: ignore[attr-defined]
    for number in range(20):
        b.peer.send("large", number)
    await until(lambda: len(b.gone) == 1)


async def test_a_client_that_leaves_is_told_of_once_and_its_requests_end(b: Bench) -> None:
    b.peer.send("wait", 1)
    await b.peer.call("stop")
    await b.peer.close()
    await until(lambda: len(b.gone) == 1)
    assert len(b.server._connections) == 1, "its request is still under way"
    b.gate.set()
    await until(lambda: not b.server._connections)
    assert len(b.gone) == 1


async def test_a_half_closed_client_gets_its_answers(b: Bench) -> None:
    b.peer.send("echo", 1, number=1)
    b.peer.writer.write_eof()
    assert (await b.peer.receive())["id"] == 1
    assert await b.peer.ended()


async def test_one_client_too_many_takes_the_place_of_the_one_that_never_asked(b: Bench) -> None:
    await b.peer.call("look")
    first = await b.connect()
    for _ in range(USER_PLACES - 2):
        await b.connect()
    await until(lambda: len(b.server._connections) == USER_PLACES)
    late = await b.connect()
    assert "result" in await late.call("stop")
    error = (await first.receive())["error"]
    assert error["data"]["code"] == "BUSY"
    assert f"{USER_PLACES} connections a user" in error["message"]
    assert await first.ended()
    assert len(b.server._connections) == USER_PLACES
    assert "result" in await b.peer.call("look")


async def test_too_many_clients_that_all_want_something_are_refused_in_words(b: Bench) -> None:
    for _ in range(USER_PLACES - 1):
        await (await b.connect()).call("subscribe")
    await b.peer.call("subscribe")
    late = await b.connect()
    error = (await late.receive())["error"]
    assert error["data"]["code"] == "BUSY"
    assert all(word in error["message"] for word in (f"uid {os.getuid()}", str(USER_PLACES), "armctl stop"))
    assert await late.ended()


async def test_a_place_that_was_given_up_is_free_at_once_though_its_client_reads_nothing(b: Bench) -> None:
    for _ in range(2 * USER_PLACES):
        await b.connect()
    await until(lambda: len(b.gone) == USER_PLACES + 1)
    assert len(b.server._connections) == USER_PLACES


async def test_who_connects_too_often_is_sent_away_and_who_is_there_is_served(b: Bench) -> None:
    await b.peer.call("look")
    for _ in range(int(COMINGS_BURST) - 1):
        await (await b.connect()).close()
    late = await b.connect()
    error = (await late.receive())["error"]
    assert error["data"]["code"] == "RATE_LIMIT"
    assert all(word in error["message"] for word in (f"uid {os.getuid()}", "100 times a second", "armctl stop"))
    assert await late.ended()
    assert "result" in await b.peer.call("stop")
    b.clock.advance_ns(NS_PER_S)
    assert "result" in await (await b.connect()).call("stop")


async def test_where_no_file_is_left_for_a_connection_the_next_one_is_let_in_later(
    b: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "AGAIN_S", 0.01)
    await b.peer.call("look")
    there = b.server._listening
    assert there is not None
    b.server._listening = Full(there)  # type: ignore[assignment]
    b.server._accept()
    b.server._listening = there
    assert "result" in await (await b.connect()).call("stop")


async def test_who_never_asks_is_sent_away_with_a_word_and_who_has_asked_or_subscribed_may_be_silent(
    b: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "IDLE_S", 0.2)
    subscriber, silent = await b.connect(), await b.connect()
    await subscriber.call("subscribe")
    await b.peer.call("look")
    nonsense = await b.connect()
    nonsense.send_raw(b"hello\n")
    assert (await nonsense.receive())["error"]["code"] == jsonrpc.PARSE_ERROR
    for idle in (silent, nonsense):
        error = (await idle.receive())["error"]
        assert error["data"]["code"] == "IDLE"
        assert all(word in error["message"] for word in (str(os.getpid()), "0.2 s", "connect when"))
        assert await idle.ended()
    assert len(b.server._connections) == 2
    assert "result" in await b.peer.call("echo", number=1)


async def test_a_line_left_unfinished_ends_the_connection_however_often_a_byte_comes(
    b: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "LINE_S", 0.2)
    await b.peer.call("look")

    async def trickle() -> None:
        while not b.peer.writer.is_closing():
            b.peer.send_raw(b" ")
            await asyncio.sleep(0.02)

    trickling = asyncio.create_task(trickle())
    error = (await b.peer.receive())["error"]
    assert error["data"]["code"] == "IDLE"
    assert all(word in error["message"] for word in ("0.2 s", "bytes", "at once"))
    await until(lambda: len(b.gone) == 1)
    trickling.cancel()


@given(cuts=st.lists(st.integers(0, 200), max_size=20))
@settings(max_examples=20, deadline=None)
def test_requests_are_the_same_wherever_their_bytes_are_cut(cuts: list[int]) -> None:
    async def ask() -> list[int]:
        async with bench() as b:
            whole = b"".join(
                json.dumps({"jsonrpc": "2.0", "id": n, "method": "echo", "params": {"number": n}}).encode() + b"\n"
                for n in range(3)
            )
            ends = sorted({min(cut, len(whole)) for cut in cuts} | {len(whole)})
            for begin, end in zip([0, *ends], ends, strict=False):
                b.peer.send_raw(whole[begin:end])
                await asyncio.sleep(0)
            return [(await b.peer.receive())["result"]["number"] for _ in range(3)]

    assert asyncio.run(ask()) == [0, 1, 2]


async def test_a_long_line_that_is_not_paid_for_is_refused_unread_and_stop_is_served_behind_it(b: Bench) -> None:
    # Each is refused as unread or as no request, which tells whether it was parsed.
    for _ in range(10):
        b.peer.send_raw(b"[" + b" " * 65000 + b"]\n")
    b.peer.send("stop", 7)
    codes = []
    while (answer := await b.peer.receive())["id"] != 7:
        codes.append(answer["error"]["data"]["code"])
    assert "result" in answer
    assert codes[1:] == ["RATE_LIMIT"] * 9
    assert codes[0] != "RATE_LIMIT"


async def test_clients_are_known_by_process_and_user(b: Bench) -> None:
    await b.peer.call("subscribe")
    assert b.seen[0].name == f"pid {os.getpid()} (uid {os.getuid()})"


async def test_who_may_not_command_may_look_and_stop() -> None:
    async with bench(may_command=False) as b:
        error = (await b.peer.call("echo", number=1))["error"]
        assert error["data"]["code"] == "NOT_A_COMMANDER"
        assert f"uid {os.getuid()}" in error["message"]
        assert "`commanders`" in error["message"]
        assert (await b.peer.call("look"))["result"] == {"state": "holding"}
        assert (await b.peer.call("stop"))["result"] == {"state": "holding"}


async def test_closing_the_server_cancels_what_does_not_end_without_a_word(b: Bench) -> None:
    complaints: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
    b.peer.send("wait", 1)
    await b.peer.call("stop")
    await b.server.close()
    assert not b.server._connections
    assert len(b.gone) == 1
    assert await b.peer.ended()
    assert complaints == []


async def test_hardly_any_line_of_a_flood_is_served_before_a_stop_that_came_behind_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    served: list[int] = []
    charge = Account.charge

    def counted(account: Account, size: int, now_s: float) -> tuple[bool, float]:
        served.append(size)
        return charge(account, size, now_s)

    monkeypatch.setattr(Account, "charge", counted)
    async with bench() as b:
        flooder, other = b.peer, await b.connect()
        flood = asyncio.create_task(_flood(flooder))
        await until(lambda: len(served) > 2 * BURST)
        between = []
        for _ in range(20):
            before = len(served)
            assert "result" in await other.call("stop")
            between.append(len(served) - before)
        flood.cancel()
        await asyncio.gather(flood, return_exceptions=True)
    # The stop's own line, and one of the flood for each turn of the loop that takes it in and sends its answer.
    assert max(between) <= 10


async def _flood(peer: Peer) -> None:
    """Send as fast as is read, and read what is answered."""
    line = b'{"jsonrpc":"2.0","id":1,"method":"echo","params":{"number":1}}\n' * 100

    async def drained() -> None:
        while await peer.reader.read(1 << 16):
            pass

    reading = asyncio.create_task(drained())
    try:
        while True:
            peer.send_raw(line)
            await peer.writer.drain()
            await asyncio.sleep(0)
    finally:
        reading.cancel()
