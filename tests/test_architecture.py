"""ARCHITECTURE.md is true where a machine can tell: every file and every name in it exists.

Its table of layers is held by `test_layers.py`.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
QUOTED = re.findall(r"`([^`\n]+)`", TEXT)
# Of tests, of the system, or for a name to be chosen.
ELSEWHERE = {"ROWS", "NAME", "NAME_command", "SOCK_SEQPACKET", "SCHED_FIFO", "PYTHONPATH"}


def names() -> set[str]:
    """Every name in the package's code: of what is defined, used, and given."""
    paths = sorted((ROOT / "armctl").rglob("*.py"))
    nodes = (node for path in paths for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    found = {getattr(node, kind, None) for node in nodes for kind in ("name", "id", "attr", "arg")}
    return {name for name in found if name} | {path.stem for path in paths}


def exists(path: str) -> bool:
    return any((folder / path).exists() for folder in (ROOT, ROOT / "armctl", ROOT / "armctl" / "sim"))


def test_every_file_and_folder_that_it_names_is_there() -> None:
    paths = [word for word in QUOTED if re.fullmatch(r"[\w./-]+(\.(py|md|yaml)|/)", word)]
    assert len(paths) > 60
    assert [path for path in paths if not exists(path)] == []


def test_every_function_class_and_constant_that_it_names_is_there() -> None:
    words = {word for quoted in QUOTED for word in re.findall(r"^(?:\w+\.)*(\w+)(?:\(.*\))?$", quoted)}
    code = {word for word in words if "_" in word or (re.search(r"[A-Z]", word) and not word.isdigit())}
    assert len(code) > 60
    known = names() | ELSEWHERE
    assert sorted(word for word in code if word not in known and not exists(word)) == []
