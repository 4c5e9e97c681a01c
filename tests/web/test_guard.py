import json

import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.types import Receive, Scope, Send

from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.web.guard import HEADERS, TOKEN_HEADER, Guard
from armctl.web.tokens import Tokens
from tests.web.asking import TOKEN, asked, streamed

OWN = {"host": "127.0.0.1:8080", TOKEN_HEADER: TOKEN}
JSON = {"content-type": "application/json"}


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers with the body it was let have; accepts every WebSocket."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    message = await receive()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": message.get("body", b"")})


GUARD = Guard(echo, tokens=Tokens(None, TOKEN), port=8080)


def ask(method: str, path: str, headers: dict[str, str], body: bytes = b"") -> httpx.Response:
    return asked(GUARD, method, path, headers, content=body)


def code(response: httpx.Response) -> str:
    return str(response.json()["error"]["code"])


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080"])
def test_the_servers_own_names_are_served(host: str) -> None:
    assert ask("GET", "/api/status", {**OWN, "host": host}).status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:80", "127.0.0.1:8080.evil.example", "LOCALHOST:8080", ""]
)
def test_any_other_host_is_refused(host: str) -> None:
    response = ask("GET", "/", {**OWN, "host": host})
    assert (response.status_code, code(response)) == (421, "WRONG_HOST")


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:8080", "http://127.0.0.1:9"])
def test_a_foreign_origin_is_refused(origin: str) -> None:
    response = ask("POST", "/api/stop", {**OWN, **JSON, "origin": origin}, b"{}")
    assert (response.status_code, code(response)) == (403, "WRONG_ORIGIN")


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_what_another_site_fetches_is_refused(site: str) -> None:
    assert ask("GET", "/", {**OWN, "sec-fetch-site": site}).status_code == 403


@pytest.mark.parametrize("site", ["same-origin", "none"])
def test_the_page_itself_and_a_typed_address_are_served(site: str) -> None:
    headers = {**OWN, "origin": "http://127.0.0.1:8080", "sec-fetch-site": site}
    assert ask("GET", "/api/status", headers).status_code == 200


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=30).filter(lambda text: text != TOKEN))
@settings(max_examples=30)
def test_without_the_token_nothing_below_api_is_served(token: str) -> None:
    response = ask("GET", "/api/status", {**OWN, TOKEN_HEADER: token})
    assert (response.status_code, code(response)) == (401, "NO_TOKEN")


def test_pages_need_no_token_and_every_answer_carries_the_headers() -> None:
    for path, headers in (("/", {"host": "127.0.0.1:8080"}), ("/", {"host": "evil"})):
        response = ask("GET", path, headers)
        assert {name: response.headers[name] for name in HEADERS} == HEADERS
    assert "script-src 'self';" in HEADERS["content-security-policy"]


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
def test_only_json_is_taken(kind: str) -> None:
    assert ask("POST", "/api/stop", {**OWN, "content-type": kind}, b"{}").status_code == 415


@pytest.mark.parametrize(
    "body", [b"{", b'{"a":NaN}', b'{"a":1e999}', b'{"a":1,"a":2}', b"[" * 17 + b"]" * 17, b"\xff", b'"\\ud800"']
)
def test_json_is_read_as_strictly_as_on_the_socket(body: bytes) -> None:
    response = ask("POST", "/api/stop", {**OWN, **JSON}, body)
    assert (response.status_code, code(response)) == (400, "NOT_JSON")


def test_a_body_arrives_unchanged_up_to_its_limit() -> None:
    body = json.dumps({"a": "x" * (MAX_LINE_BYTES - 20)}).encode()
    assert ask("POST", "/api/stop", {**OWN, **JSON}, body).content == body
    assert ask("POST", "/api/stop", {**OWN, **JSON}, body + b" " * 20).status_code == 413


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
def test_a_websocket_needs_the_servers_own_origin(origin: str | None) -> None:
    [closed] = streamed(GUARD, origin=origin)
    assert (closed["type"], closed["code"]) == ("websocket.close", 1008)
    assert streamed(GUARD) == [{"type": "websocket.accept"}]
