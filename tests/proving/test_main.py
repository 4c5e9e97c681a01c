"""`tools/prove` and `tools/bench` as commands: names, JSON, exit status."""

import importlib
import json
import sys
from typing import Any

import pytest
from click.testing import CliRunner

from proving import __main__ as proving


@pytest.mark.parametrize(("command", "known"), [("prove", "'wire'"), ("bench", "'jitter'")])
def test_an_unknown_name_lists_the_known_ones(command: str, known: str) -> None:
    result = CliRunner().invoke(proving.main, [command, "nonsense"])
    assert result.exit_code == 2
    assert known in result.stderr


@pytest.mark.parametrize(("violations", "status"), [(0, 0), (2, 1)])
def test_a_proof_prints_one_object_and_fails_on_violations(
    monkeypatch: pytest.MonkeyPatch, violations: int, status: int
) -> None:
    monkeypatch.setitem(proving.PROOFS, "wire", lambda seed: {"runs": 3, "violations": violations, "seed": seed})
    result = CliRunner().invoke(proving.main, ["prove", "wire", "--seed", "9", "--json"])
    assert result.exit_code == status
    assert json.loads(result.stdout) == {"runs": 3, "violations": violations, "seed": 9}


@pytest.mark.parametrize(("told", "says"), [
    (("lines", "--classes", "radial,sideways"), "no class sideways; there are turning, radial"),
    (("lines", "--targets", "3"), "lines takes no --targets"),
    (("place", "--classes", "radial"), "place takes no --classes"),
])  # fmt: skip
def test_an_option_that_a_proof_does_not_know_is_refused_before_it_runs(told: tuple[str, ...], says: str) -> None:
    result = CliRunner().invoke(proving.main, ["prove", *told])
    assert result.exit_code == 2
    assert says in " ".join(result.stderr.replace("│", " ").split())


def test_lines_are_told_their_classes_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(proving.PROOFS, "lines", lambda seed, **given: {"violations": [], **given})
    result = CliRunner().invoke(
        proving.main, ["prove", "lines", "--classes", "radial,vertical", "--arms", "3", "--json"]
    )
    assert json.loads(result.stdout) == {"violations": [], "classes": ["radial", "vertical"], "arms": 3}


def test_all_benches_make_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    def bench(seed: int) -> dict[str, Any]:
        row = {"work": "w", "who": "armctl", "value": 1.0, "unit": "ms", "ratio": 1.0}
        return {"rows": [row], "checks": [{"name": "c", "value": 1.0, "bound": 2.0, "ok": True}], "seed": seed}

    for name in proving.BENCHES:
        monkeypatch.setitem(proving.BENCHES, name, bench)
    result = json.loads(CliRunner().invoke(proving.main, ["bench", "all", "--json"]).stdout)
    assert len(result["rows"]) == len(proving.BENCHES)
    shown = CliRunner().invoke(proving.main, ["bench", "bus"])
    assert shown.exit_code == 0
    assert "held   c: 1.000, bound 2" in shown.stdout


@pytest.mark.parametrize(("violations", "status"), [(0, 0), (1, 1)])
@pytest.mark.parametrize("how", [(), ("--json",)])
def test_a_bench_that_counts_violations_fails_on_them(
    monkeypatch: pytest.MonkeyPatch, violations: int, status: int, how: tuple[str, ...]
) -> None:
    check = {"name": "c", "value": 1.0 + violations, "bound": 1.0, "ok": not violations}
    answer = {"rows": [], "checks": [check], "violations": violations, "seed": 1}
    monkeypatch.setitem(proving.BENCHES, "start", lambda _: answer)
    result = CliRunner().invoke(proving.main, ["bench", "start", *how])
    assert result.exit_code == status
    assert ("MISSED" in result.stdout) == (bool(violations) and not how)


def test_a_missing_peer_is_one_sentence_and_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pygad", None)
    monkeypatch.setitem(proving.BENCHES, "ga", lambda _: importlib.import_module("pygad"))
    monkeypatch.setattr(sys, "argv", ["bench", "bench", "ga"])
    with pytest.raises(SystemExit) as ended:
        proving.run()
    told = capsys.readouterr().err
    assert ended.value.code == 1
    assert told.startswith("pygad, ")
    assert told.count("\n") == 1
