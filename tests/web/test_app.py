"""The application behind the guard: what it keeps, what it refuses, and what a page's stream begins with."""

import gzip
import json
import math
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import Config
from armctl.errors import NoDaemon
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.recording.recordings import load
from armctl.web.app import create_app
from armctl.web.connections import Connections
from armctl.web.guard import HEADERS, TOKEN_HEADER, WRONG_BURST, Guard
from tests.web.asking import TOKEN, asked, streamed
from tests.words import missing

RELEASED = Path(__file__).parent.parent / "recording" / "released"
PAGES = ("/", "/app.js", "/scene.js", "/three.js", "/style.css", "/icon.svg")


def served(folder: Path, arm: str = "ax12-line") -> Guard:
    """The application over what is kept in a folder."""
    return create_app(Config(arm=arm, data_dir=str(folder)), socket=folder / "nobody.sock", token=TOKEN, port=8080)[1]


@pytest.fixture(scope="module")
def guard(tmp_path_factory: pytest.TempPathFactory) -> Guard:
    folder = tmp_path_factory.mktemp("data")
    (folder / "logs").mkdir()
    (folder / "logs" / "bad.mcap").write_bytes(b"no log")
    (folder / "logs" / "link.mcap").symlink_to("/etc/hostname")
    return served(folder)


def get(guard: Guard, path: str, **headers: str) -> httpx.Response:
    return asked(guard, "GET", path, {TOKEN_HEADER: TOKEN} | {key.replace("_", "-"): headers[key] for key in headers})


@pytest.mark.parametrize("path", PAGES)
def test_pages_are_kept_by_the_browser_and_asked_about(guard: Guard, path: str) -> None:
    first = get(guard, path)
    assert (first.status_code, first.headers["cache-control"]) == (200, "no-cache")
    again = get(guard, path, if_none_match=first.headers["etag"])
    assert (again.status_code, again.content) == (304, b"")
    kept = {"etag": first.headers["etag"], "content-security-policy": HEADERS["content-security-policy"]}
    assert {name: again.headers[name] for name in kept} == kept
    assert get(guard, path, if_none_match='W/"other"').status_code == 200


def test_pages_come_packed_to_who_can_unpack(guard: Guard) -> None:
    plain = get(guard, "/app.js", accept_encoding="identity")
    assert "content-encoding" not in plain.headers
    packed = get(guard, "/app.js", accept_encoding="gzip")
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.content == plain.content  # httpx has unpacked it
    assert len(gzip.compress(plain.content)) < len(plain.content) / 2


def turned(direction: FloatArray, angle_rad: float) -> FloatArray:
    """A rotation about a unit vector (Rodrigues)."""
    x, y, z = direction
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle_rad) * K + (1.0 - math.cos(angle_rad)) * K @ K)


@pytest.mark.parametrize(
    "name", ["ax12-line", "crane-plus-v2", "crustcrawler", "lanzhou-4dof", "phantomx-pincher", "xiang-6dof"]
)
def test_a_page_can_place_the_arm_from_the_axes_it_is_given(tmp_path: Path, name: str) -> None:
    told = get(served(tmp_path, name), "/api/arm").json()
    arm, axes = load_arm(name), told["axes"]
    chain = robots.get(arm.robot, arm.lengths_m).chain
    assert len(axes) == chain.n
    for q in np.random.default_rng(3).uniform(-3.0, 3.0, (20, len(axes))):
        place: FloatArray = np.array(told["tool_m"])
        for axis, angle_rad in reversed(list(zip(axes, q, strict=True))):
            origin = np.array(axis["place_m"])
            place = origin + turned(np.array(axis["direction"]), angle_rad) @ (place - origin)
        np.testing.assert_allclose(place, tool_position(chain, q), atol=1e-12)


def test_the_arm_is_the_one_that_the_daemon_drives_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: dict[str, str] = {}

    async def call(_: Connections, method: str) -> dict[str, str]:
        assert method == "status"
        if not driven:
            raise NoDaemon("nobody answers")
        return driven

    monkeypatch.setattr(Connections, "call", call)
    guard = served(tmp_path)
    assert get(guard, "/api/arm").json()["arm_id"] == "ax12-line"
    for name in ("crane-plus-v2", "lanzhou-4dof"):  # the daemon was started again
        arm = load_arm(name)
        driven |= {"arm_id": name, "calibration_hash": arm.calibration_hash}
        told = get(guard, "/api/arm").json()
        assert {key: told[key] for key in driven} == driven
        assert [joint["name"] for joint in told["joints"]] == list(arm.joint_names)
    driven["calibration_hash"] = "of-no-file"
    answer = get(guard, "/api/arm")
    assert (answer.status_code, answer.json()["error"]["code"]) == (422, "CONFIG")
    assert not missing(answer.text, "the daemon drives arm lanzhou-4dof", "of-no-file", "`arm` in the configuration")
    driven.clear()  # there is none any more
    assert get(guard, "/api/arm").json()["arm_id"] == "lanzhou-4dof"


def test_answers_of_the_interface_are_not_kept(guard: Guard) -> None:
    assert get(guard, "/api/arm").headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/api/status", 503, "NO_DAEMON"),
        ("/api/logs/none.mcap", 404, "LOG"),
        ("/api/logs/link.mcap", 404, "LOG"),
        ("/api/logs/link.mcap/file", 404, "LOG"),
        ("/api/logs/bad.mcap", 404, "LOG"),
        ("/api/logs/.hidden", 422, "INVALID"),
        ("/api/plans/none", 503, "NO_DAEMON"),
        ("/api/plans/a%0A", 422, "INVALID"),
        ("/api/recordings/", 404, "NOT_FOUND"),
        ("/api/logs/bad.mcap?from_s=nan", 422, "INVALID"),
        ("/api/logs/find?expression=servo:x", 422, "CONFIG"),
        (f"/api/logs/find?expression=servo:{2**63}", 422, "CONFIG"),
        ("/api/logs/find", 422, "INVALID"),
        ("/api/stop", 405, "WRONG_METHOD"),
        ("/nothing", 404, "NOT_FOUND"),
    ],
)
def test_what_cannot_be_served_is_refused_with_the_socket_s_codes(
    guard: Guard, path: str, status: int, code: str
) -> None:
    answer = get(guard, path)
    assert answer.status_code == status
    error = answer.json()["error"]
    assert error == {"code": code, "message": error["message"], "reasons": error["reasons"]}
    assert all(error.values())


def test_the_newest_log_comes_first_whatever_its_name(tmp_path: Path) -> None:
    names = ["armctl-2.mcap.part", "fault-2.mcap", "armctl-1.mcap", "fault-1.mcap"]
    (tmp_path / "logs").mkdir()
    for age_s, name in enumerate(names):
        (tmp_path / "logs" / name).touch()
        os.utime(tmp_path / "logs" / name, (1e9 - age_s, 1e9 - age_s))
    assert [log["name"] for log in get(served(tmp_path), "/api/logs").json()["logs"]] == names


def test_what_cannot_be_opened_is_not_listed(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    for name in ("armctl-1.mcap", "armctl-2.mcap.part", "armctl-3.mcap.part.broken", "armctl-4.mcapx"):
        (tmp_path / "logs" / name).touch()
    (tmp_path / "logs" / "link.mcap").symlink_to("/etc/hostname")
    listed = [log["name"] for log in get(served(tmp_path), "/api/logs").json()["logs"]]
    assert sorted(listed) == ["armctl-1.mcap", "armctl-2.mcap.part"]


def test_a_log_of_another_arm_is_not_drawn_as_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "logs").mkdir()
    shutil.copy(RELEASED / "0.2.0.mcap", tmp_path / "logs" / "old.mcap")
    assert get(served(tmp_path), "/api/logs/old.mcap").status_code == 200
    answer = get(served(tmp_path, "xiang-6dof"), "/api/logs/old.mcap")
    assert answer.status_code == 404
    assert not missing(answer.json()["error"]["message"], "of ax12-line with base, ", "is xiang-6dof with waist, ")
    track = load(RELEASED / "0.2.0.mcap")
    fewer = track._replace(joint_names=track.joint_names[:3], positions_rad=track.positions_rad[:, :3])
    monkeypatch.setattr("armctl.web.files.load", lambda _: fewer)
    answer = get(served(tmp_path), "/api/logs/old.mcap")
    assert not missing(answer.json()["error"]["message"], "with base, shoulder, elbow; ", "is ax12-line with base, ")


def test_a_field_that_does_not_fit_is_named_with_its_bound(guard: Guard) -> None:
    error = get(guard, "/api/logs/bad.mcap?from_s=-1").json()["error"]
    assert error["reasons"] == ["query.from_s: Input should be greater than or equal to 0"]


def test_what_happened_is_found_in_the_logs_the_newest_first(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    shutil.copy(next(RELEASED.glob("*.mcap")), tmp_path / "logs" / "old.mcap")
    answer = get(served(tmp_path), "/api/logs/find?expression=log:old.mcap").json()
    times = [event["time"] for event in answer["found"]]
    assert times == sorted(times, reverse=True)
    assert {event["log"] for event in answer["found"]} == {"old.mcap"}
    assert answer["left_off"] == 0


@pytest.mark.parametrize(
    ("path", "body"), [("/api/hand", {"from_m": [0.2, 0.1, 0.1], "to_m": [0.2, -0.1, 0.1]}), ("/api/hand/let-go", {})]
)
def test_an_arm_that_is_not_simulated_has_no_hand(guard: Guard, path: str, body: dict[str, object]) -> None:
    assert get(guard, "/api/arm").json()["simulated"] is False
    headers = {TOKEN_HEADER: TOKEN, "Content-Type": "application/json"}
    answer = asked(guard, "POST", path, headers, content=json.dumps(body))
    assert answer.status_code == 409
    assert "no simulator listens here" in answer.json()["error"]["message"]


@pytest.mark.parametrize("refine", [-1, 21, 1.5, "x"])
def test_a_run_takes_as_many_corrections_as_one_from_the_command_line(guard: Guard, refine: object) -> None:
    headers = {TOKEN_HEADER: TOKEN, "Content-Type": "application/json"}
    answer = asked(guard, "POST", "/api/plans/none/run", headers, content=json.dumps({"refine": refine}))
    assert (answer.status_code, answer.json()["error"]["code"]) == (422, "INVALID")
    assert "body.refine" in answer.json()["error"]["message"]
    answer = asked(guard, "POST", "/api/plans/none/run", headers, content=json.dumps({"refine": 20}))
    assert (answer.status_code, answer.json()["error"]["code"]) == (503, "NO_DAEMON"), "which keeps the plans"


def test_a_method_that_is_not_served_says_which_are(guard: Guard) -> None:
    assert get(guard, "/api/stop").headers["allow"] == "POST"


ODD = ["", "{}", "[" * 4000, '{"token": "\\ud800"}', '{"token": 1e999}', '{"token": null}', '"x"']
GUESSED = st.text(max_size=20).filter(lambda text: text != TOKEN).map(lambda text: json.dumps({"token": text}))


@given(st.text(max_size=60) | st.sampled_from(ODD) | GUESSED)
@settings(max_examples=60)
def test_a_stream_without_the_token_is_closed_whatever_was_said(guard: Guard, text: str) -> None:
    accepted, closed = streamed(guard, {"type": "websocket.receive", "text": text})
    assert accepted["type"] == "websocket.accept"
    assert (closed["type"], closed["code"]) == ("websocket.close", 1008)


def test_wrong_tokens_of_streams_are_counted_with_those_of_requests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armctl.web.guard.time", SimpleNamespace(monotonic=lambda: 0.0))  # no allowance comes back
    guard = served(tmp_path)
    wrong = {"type": "websocket.receive", "text": json.dumps({"token": "x"})}
    closed = [streamed(guard, wrong)[-1] for _ in range(int(WRONG_BURST) + 1)]
    assert {one["code"] for one in closed} == {1008}
    reasons = ["the token is missing or wrong"] * int(WRONG_BURST) + ["too many wrong tokens"]
    assert [one["reason"] for one in closed] == reasons
    assert get(guard, "/api/arm", **{TOKEN_HEADER: "x"}).status_code == 429


def test_bytes_are_no_token(guard: Guard) -> None:
    assert streamed(guard, {"type": "websocket.receive", "bytes": b"x"})[-1]["type"] == "websocket.close"


def test_with_the_token_the_stream_begins_with_what_is_known(guard: Guard) -> None:
    accepted, first = streamed(guard, {"type": "websocket.receive", "text": json.dumps({"token": TOKEN})})
    assert accepted["type"] == "websocket.accept"
    assert json.loads(first["text"]) == {"kind": "snapshot", "snapshot": None}
