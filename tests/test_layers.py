"""Imports go down only: the layers of ARCHITECTURE.md, held by reading every import statement."""

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "armctl"

# Lower layers first, as the table of ARCHITECTURE.md has them; a package, or a module at the root, may import its own
# layer and those below it.
ARCHITECTURE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
LAYERS = [
    [room.strip("`/") for room in rooms.split(", ")]
    for rooms in re.findall(r"^\| \d+ \| (.*?) \|", ARCHITECTURE, flags=re.MULTILINE)
] + [["__main__"]]
IMPURE_CONTROL = ("loop", "link", "process", "stop_lane")
PURE = (
    "armctl.errors",
    "armctl.messages",
    "armctl.json_text",
    "armctl.links",
    "armctl.pair",
    "armctl.gripper",
    "armctl.config",
    "armctl.dynamixel.packet",
    "armctl.dynamixel.fitness",
    "armctl.dynamixel.ax12a",
    "armctl.kinematics",
    "armctl.trajectory",
    "armctl.genetic",
    *(
        f"armctl.control.{path.stem}"
        for path in (PACKAGE / "control").glob("[a-z]*.py")
        if path.stem not in IMPURE_CONTROL
    ),
)
IMPURE = {
    *("serial", "dynamixel_sdk", "socket", "os", "pathlib", "time"),
    *("threading", "asyncio", "subprocess", "multiprocessing"),
}
# The simulator itself meets the bus at the bytes; only the builder of a whole arm knows both.
SIM = sorted(path.stem for path in (PACKAGE / "sim").glob("[a-z]*.py") if path.stem != "virtual_arm")
# (who, what it must not know, not even through others), beyond what the layers say.
FORBIDDEN = (
    *((f"armctl.sim.{name}", f"armctl.{other}") for name in SIM for other in ("dynamixel.bus", "control")),
    *((f"armctl.{name}", "armctl.sim") for name in ("dynamixel", "control", "host")),
    *(("armctl.client", f"armctl.{other}") for other in ("host", "control", "recording")),
)


def modules() -> dict[str, Path]:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


@functools.cache
def imports(module: str) -> frozenset[str]:
    """What a module of armctl imports, its own modules by their whole names."""
    path = MODULES[module]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            base = node.module or ""
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names if f"{base}.{alias.name}" in MODULES)
    return frozenset(names)


def within(module: str, part: str) -> bool:
    return module == part or module.startswith(part + ".")


def layer(module: str) -> int:
    """Index of a module's layer; the package itself, which has only the version, is below all."""
    room = module.partition(".")[2].partition(".")[0]
    found = [index for index, rooms in enumerate(LAYERS) if room in rooms]
    assert found or not room, f"{module} stands in no layer; add it to the table of ARCHITECTURE.md"
    return found[0] if found else 0


@functools.cache
def reached(module: str, packages: bool = True) -> frozenset[str]:
    """Every module of armctl that importing this one imports, directly or through others.

    Args:
        packages: Whether the packages count that a module lies in: they are imported with it.
    """
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in MODULES and name not in found:
            found.add(name)
            waiting.extend(imports(name) | ({name.rpartition(".")[0]} if packages else set()))
    return frozenset(found)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_go_down_only(module: str) -> None:
    for name in imports(module):
        if within(name, "armctl"):
            assert layer(name) <= layer(module), f"{module} imports {name}, which stands above it"


def test_no_two_rooms_import_each_other() -> None:
    """Not for types alone either: rooms of one layer may import in one direction."""
    rooms = {
        (module.split(".")[1], name.split(".")[1])
        for module in MODULES
        for name in imports(module)
        if name.startswith("armctl.") and "." in module
    }
    assert not [(room, other) for room, other in rooms if room < other and (other, room) in rooms]


def test_no_module_imports_itself_through_others() -> None:
    """Not for types alone either. A package may import its modules, which are imported through it."""
    for module in MODULES:
        for name in imports(module) & MODULES.keys():
            back = not within(name, module) and not within(module, name) and module in reached(name, packages=False)
            assert not back, f"{module} and {name} import each other"


@pytest.mark.parametrize("module", sorted(name for name in MODULES if any(within(name, part) for part in PURE)))
def test_pure_modules_reach_neither_time_nor_files_nor_threads(module: str) -> None:
    for name in reached(module):
        assert not {found.split(".")[0] for found in imports(name)} & IMPURE, f"{module} reaches {name}"
        assert not re.search(r"\bopen\(", MODULES[name].read_text(encoding="utf-8")), f"{module} reaches {name}"


@pytest.mark.parametrize(("who", "what"), FORBIDDEN)
def test_parts_that_must_not_know_each_other_do_not(who: str, what: str) -> None:
    for module in MODULES:
        if within(module, who):
            assert not any(within(name, what) for name in imports(module)), f"{module} imports {what}"


def test_nothing_asks_whether_the_servos_are_simulated() -> None:
    for module, path in MODULES.items():
        assert not re.search(r"\bif (not )?(\w+\.)?_?(is_)?simulated\b(?!\.)", path.read_text(encoding="utf-8")), module


def test_no_module_hides_behind_a_name_that_says_nothing() -> None:
    assert not {module.split(".")[-1] for module in MODULES} & {"utils", "helpers", "common", "misc", "manager"}


def test_the_top_level_holds_only_what_belongs_there() -> None:
    allowed = {"pyproject.toml", "armctl", "calibration", "tools", "tests", "systemd", "README.md", "ARCHITECTURE.md"}
    allowed |= {"CHANGELOG.md", "LICENSE", "armctl-demo", "build", "dist"}
    assert {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} <= allowed
