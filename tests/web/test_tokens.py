"""Who may open the page: people's tokens, kept as hashes, and what each of them opens."""

import fcntl
import json
import os
import stat
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.cli import main
from armctl.errors import ConfigError
from armctl.web import tokens as module
from armctl.web.guard import PERSON, TOKEN_HEADER, WRONG_BURST, Guard
from armctl.web.tokens import LOCAL, Tokens, add, people, revoke
from tests.web.asking import TOKEN, asked
from tests.web.test_guard import JSON, OWN, code, echo


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "etc" / "web-tokens.json"


def test_a_token_opens_the_page_until_it_is_revoked(path: Path) -> None:
    tokens = Tokens(path, TOKEN)
    _, token = add(path, "ada", "command")
    _, other = add(path, "linus", "look")
    assert [(one.name, one.role) for one in people(path)] == [("ada", "command"), ("linus", "look")]
    assert [one and one.name for one in map(tokens.who, (token, other, TOKEN))] == ["ada", "linus", LOCAL]
    revoke(path, "ada")
    assert tokens.who(token) is None
    assert tokens.who(other) is not None


def test_no_token_is_kept_and_only_owner_and_group_read_the_file(path: Path) -> None:
    _, token = add(path, "ada", "command")
    assert token not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@given(said=st.none() | st.integers() | st.text() | st.binary())
def test_nothing_else_opens_the_page(said: object) -> None:
    assert Tokens(None, TOKEN).who(said) is None or said == TOKEN


@pytest.mark.parametrize("name", ["", "ada lovelace", "../ada", "ada\n", LOCAL])
def test_what_is_no_name_of_a_person_gets_no_token(path: Path, name: str) -> None:
    with pytest.raises(ConfigError):
        add(path, name, "command")
    assert not path.exists()


def test_a_name_has_one_token_and_an_unknown_one_is_told_the_known(path: Path) -> None:
    add(path, "ada", "command")
    with pytest.raises(ConfigError, match="revoke it first"):
        add(path, "ada", "look")
    with pytest.raises(ConfigError, match="who has one: ada"):
        revoke(path, "eve")


def test_who_adds_or_revokes_has_the_folder_alone_from_reading_to_writing(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def alone() -> bool:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(folder)
        return False

    def noted(does: Callable[..., object]) -> Callable[..., object]:
        def note(*given: object) -> object:
            seen.append(alone())
            return does(*given)

        return note

    add(path, "ada", "command")
    seen: list[bool] = []
    for name in ("people", "private"):
        monkeypatch.setattr(module, name, noted(getattr(module, name)))
    add(path, "linus", "look")
    revoke(path, "ada")
    assert seen == [True] * 4
    assert not alone()


def test_of_many_who_are_added_at_once_nobody_is_lost(path: Path) -> None:
    names = [f"person-{number}" for number in range(8)]
    with ThreadPoolExecutor(len(names)) as pool:
        tokens = dict(pool.map(lambda name: (name, add(path, name, "look")[1]), names))
    assert [one.name for one in people(path)] == names
    assert [one and one.name for one in map(Tokens(path, TOKEN).who, tokens.values())] == names


def test_a_broken_file_opens_nothing_and_the_local_address_still_does(path: Path) -> None:
    _, token = add(path, "ada", "command")
    path.write_text("[")
    assert Tokens(path, TOKEN).who(token) is None
    assert Tokens(path, TOKEN).who(TOKEN) is not None


@pytest.mark.parametrize(
    ("method", "address", "status"),
    [
        ("GET", "/api/status", 200),
        ("POST", "/api/park", 403),
        ("DELETE", "/api/plans/a", 403),
        ("POST", "/api/stop", 200),
    ],
)
def test_who_may_look_may_stop_and_nothing_else(path: Path, method: str, address: str, status: int) -> None:
    guard = Guard(echo, tokens=Tokens(path, TOKEN), port=8080)
    headers = {**OWN, TOKEN_HEADER: add(path, "linus", "look")[1], **JSON}
    answer = asked(guard, method, address, headers, content=b"{}")
    assert answer.status_code == status
    assert status != 200 or answer.headers["x-armctl-role"] == "look"  # by which the page knows what to offer


def test_the_application_is_told_whose_request_it_is(path: Path) -> None:
    seen = []

    async def app(scope: object, receive: object, send: object) -> None:
        seen.append(PERSON.get())
        await echo(scope, receive, send)  # type: ignore[arg-type]

    guard = Guard(app, tokens=Tokens(path, TOKEN), port=8080)
    asked(guard, "GET", "/api/status", {**OWN, TOKEN_HEADER: add(path, "ada", "command")[1]})
    asked(guard, "GET", "/api/status", OWN)
    assert seen == ["ada", LOCAL]


def test_wrong_tokens_are_slowed_down_and_right_ones_are_not(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armctl.web.guard.time", SimpleNamespace(monotonic=lambda: 0.0))  # no allowance comes back
    guard = Guard(echo, tokens=Tokens(path, TOKEN), port=8080)
    codes = [code(asked(guard, "GET", "/api/status", {**OWN, TOKEN_HEADER: "x"})) for _ in range(int(WRONG_BURST) + 9)]
    assert codes == ["NO_TOKEN"] * int(WRONG_BURST) + ["RATE_LIMIT"] * 9
    assert asked(guard, "GET", "/api/status", OWN).status_code == 200


@pytest.mark.parametrize(("host", "status"), [
    ("lab:8443", 200), ("lab.local:8443", 200), ("127.0.0.1:8443", 200), ("evil.example:8443", 421), ("lab:8080", 421),
])  # fmt: skip
def test_in_the_network_it_answers_to_its_own_names_alone(host: str, status: int) -> None:
    guard = Guard(echo, tokens=Tokens(None, TOKEN), port=8443, names=("lab", "lab.local"))
    own = {"host": host, "origin": f"https://{host}", TOKEN_HEADER: TOKEN}
    assert asked(guard, "GET", "/api/status", own).status_code == status
    assert asked(guard, "GET", "/api/status", own | {"origin": f"http://{host}"}).status_code in (403, 421)


def test_the_command_prints_a_token_once_and_lists_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "armctl.yaml"
    config.write_text("")
    monkeypatch.setenv("ARMCTL_CONFIG", str(config))
    assert main(["web", "token", "add", "ada", "--role", "look", "--json"]) == 0
    [added] = json.loads(capsys.readouterr().out)["tokens"]
    assert added.keys() == {"name", "role", "created", "token"}
    who = Tokens(tmp_path / "web-tokens.json", TOKEN).who(added["token"])
    assert who is not None
    assert (who.name, who.role) == ("ada", "look")
    assert main(["web", "token", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tokens"] == [{k: added[k] for k in ("name", "role", "created")}]
    assert main(["web", "token", "revoke", "ada"]) == 0
    assert main(["web", "token", "revoke", "ada"]) == 2
