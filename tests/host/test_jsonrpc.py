"""The wire: strict JSON, the standard's codes, and errors that survive the way."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.host import jsonrpc
from armctl.host.jsonrpc import MAX_DEPTH, MAX_LINE_BYTES, ProtocolError, decode


def request(**changes: Any) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "id": 1, "method": "status", "params": {}} | changes).encode()


def refusal(line: bytes) -> ProtocolError:
    with pytest.raises(ProtocolError) as caught:
        decode(line)
    return caught.value


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=10,
)


@given(st.text(), st.dictionaries(st.text(), JSON, max_size=4), st.integers() | st.text() | st.none())
def test_a_request_is_read_as_it_was_written(method: str, params: dict[str, Any], request_id: int | str | None) -> None:
    found = decode(request(method=method, params=params, id=request_id))
    assert (found.method, found.params, found.id, found.answered) == (method, params, request_id, True)


@given(st.binary() | JSON.map(lambda value: json.dumps(value).encode()))
def test_whatever_comes_is_a_request_or_a_protocol_error(line: bytes) -> None:
    refused = None
    try:
        decode(line)
    except ProtocolError as error:
        refused = error
    if refused is not None:
        assert refused.number in (jsonrpc.PARSE_ERROR, jsonrpc.INVALID_REQUEST)
        assert json.loads(jsonrpc.error_line(refused.id, refused))["error"]["code"] == refused.number


def test_a_request_without_id_is_not_answered() -> None:
    assert not decode(b'{"jsonrpc":"2.0","method":"stop"}').answered


def test_a_request_may_name_the_person_for_whom_it_is() -> None:
    assert decode(request(person="ada")).person == "ada"
    assert decode(request()).person == ""
    for wrong in ("ada\nlovelace", "a b", 1, None, ["ada"]):
        assert "person" in refusal(request(person=wrong)).problem


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        *((b'{"a":%b}' % number.encode(), number) for number in ("NaN", "Infinity", "-Infinity", "1e999", "-1e999")),
        *((b'{"%b":1}' % text, "half of a surrogate pair") for text in (rb"\ud800", rb"\udfff\ud800", rb"a\ud83d")),
        (b'{"a":{"b":1,"b":1}}', "stands twice"),
        (b'{},"params":{}', "stands twice"),
        (b'{"a":"\xff"}', "utf-8"),
        (b'{"a":%b}' % (b"9" * 5000), "digits"),
    ],
)
def test_numbers_are_finite_texts_are_whole_and_a_key_stands_once(params: bytes, problem: str) -> None:
    error = refusal(b'{"jsonrpc":"2.0","id":1,"method":"m","params":%b}' % params)
    assert error.number == jsonrpc.PARSE_ERROR
    assert problem in error.problem


def test_both_halves_of_a_surrogate_pair_are_a_character() -> None:
    assert decode(request().replace(b'"params": {}', rb'"params": {"\ud83d\ude00": 1}')).params == {"\U0001f600": 1}


def nested(depth: int) -> bytes:
    """A request nested `depth` deep, itself and its params being the first two."""
    return request().replace(b'"params": {}', b'"params": {"a": ' + b"[" * (depth - 2) + b"]" * (depth - 2) + b"}")


def test_nesting_is_bounded() -> None:
    decode(nested(MAX_DEPTH))
    assert "deep" in refusal(nested(MAX_DEPTH + 1)).problem
    assert "deep" in refusal(nested(30_000)).problem


def test_a_line_is_at_most_64_kib() -> None:
    line = request(params={"a": "x" * (MAX_LINE_BYTES - 100)})
    decode(line + b" " * (MAX_LINE_BYTES - len(line)))
    assert refusal(line + b" " * (MAX_LINE_BYTES - len(line) + 1)).number == jsonrpc.PARSE_ERROR


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (request(jsonrpc="1.0"), "jsonrpc"),
        (request(method=3), "method"),
        (request(params=[1]), "params"),
        (request(id=True), "id"),
        (request(id=1.5), "id"),
        (request(extra=1), "extra"),
        (b"[" + request() + b"]", "batch"),
    ],
)
def test_a_malformed_request_is_refused_by_the_name_of_its_fault(line: bytes, named: str) -> None:
    error = refusal(line)
    assert error.number == jsonrpc.INVALID_REQUEST
    assert named in error.problem


def test_a_defect_shows_no_more_than_its_kind() -> None:
    answer = json.loads(jsonrpc.error_line(1, KeyError("secret")))["error"]
    assert answer["code"] == jsonrpc.INTERNAL_ERROR
    assert "KeyError" in answer["message"]
    assert "secret" not in json.dumps(answer)


def depth(value: object) -> int:
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if inside is None else 1 + max(map(depth, inside), default=0)


@given(
    st.recursive(
        st.text('a"\\[]{}') | st.none(), lambda inner: st.lists(inner) | st.dictionaries(st.text("[}"), inner)
    ),
    st.integers(0, 6),
)
def test_a_text_is_as_deep_as_its_value(value: object, bound: int) -> None:
    text = json.dumps(value).encode()
    assert jsonrpc._deeper_than(text, bound) == (depth(value) > bound)
