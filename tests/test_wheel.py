"""What a person gets who has the wheel and no checkout: everything that armctl reads while it runs."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from importlib.metadata import distributions, packages_distributions
from pathlib import Path

import pytest

from armctl.cli.help import TOPICS
from armctl.commissioning.installation import UNITS

ROOT = Path(__file__).resolve().parent.parent
# Folder of the checkout -> where its files stand in the wheel.
COPIED = {"armctl": "armctl", "calibration": "armctl/calibration", "systemd": "armctl/systemd"}

Python = Callable[..., str]


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def build(folder: Path) -> Path:
    """The wheel, by the project's own build backend and without a network."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    [wheel] = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def python(wheel: Path, tmp_path: Path) -> Python:
    """Runs Python where armctl is the wheel's, in an empty folder with an empty home."""
    unpacked = tmp_path / "unpacked"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    home = tmp_path / "home"
    home.mkdir()
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("ARMCTL_", "XDG_", "PYTHON"))}

    def run(*arguments: str) -> str:
        command, environment = [sys.executable, *arguments], {**kept, "HOME": str(home), "PYTHONPATH": str(unpacked)}
        done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True, timeout=100)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert Path(run("-c", "import armctl; print(armctl.__file__)").strip()).is_relative_to(unpacked)
    return run


def test_every_file_of_the_package_is_in_the_wheel_byte_for_byte(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name: archive.read(name) for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {
        f"{place}/{path.relative_to(ROOT / folder)}": path.read_bytes()
        for folder, place in COPIED.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert set(packed) == set(wanted)
    assert [name for name in wanted if packed[name] != wanted[name]] == []


def test_the_wheel_alone_finds_every_page_calibration_unit_and_table(python: Python) -> None:
    arms = sorted(path.stem for path in (ROOT / "calibration").glob("*.yaml"))
    names = sorted(path.name for path in (ROOT / "systemd").iterdir())
    assert set(UNITS) < set(names)
    assert arms
    python(
        "-c",
        f"""
from importlib.resources import files
from armctl.cli.help import page
from armctl.files import load_arm
from armctl.commissioning.installation import template
from armctl.papers.paper_000 import printed
from armctl.web.pages import STATIC

assert all(page(topic).startswith("# ") for topic in {list(TOPICS)})
assert all(load_arm(arm).joints for arm in {arms})
assert all(template(name) for name in {names})
assert printed("delta_xy0").any()
assert {{path.name for path in STATIC.iterdir()}} >= {{"index.html", "app.js", "style.css", "icon.svg"}}
assert files("armctl").joinpath("docs/foxglove-layout.json").read_bytes()
""",
    )


def test_the_wheel_alone_answers_and_installs(python: Python) -> None:
    assert "ax12-line" in python("-m", "armctl", "robots")
    assert "Five minutes" in python("-m", "armctl", "help", "start")
    told = python("-m", "armctl", "install", "--dry-run", "--prefix", sys.prefix, "--root", "/nowhere")
    assert all(f"would write /etc/systemd/system/{unit}" in told for unit in UNITS)


def test_the_demonstration_and_every_page_need_no_extra(python: Python) -> None:
    needed = {plain(one.name): one.requires or [] for one in distributions()}
    waiting = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    core = {"armctl"}
    while waiting:
        one = waiting.pop()
        if "extra ==" not in one and (name := plain(re.split(r"[^\w.-]", one)[0])) not in core:
            core.add(name)
            waiting += needed.get(name, [])
    owners = packages_distributions().items()
    others = [module for module, names in owners if core.isdisjoint(map(plain, names))]
    assert {"sympy", "fastapi"} <= set(others)
    python(
        "-c",
        f"""
import sys
sys.modules.update(dict.fromkeys({others}))  # importing one of them fails
from pathlib import Path
from armctl.lab import demo
from armctl.report import experiment, kinematics, line, log, pareto, transfer_curves
from armctl.report.page import Page
page = Page("Kinds")
with page.chart("two bars", "Bars", "x", "y") as chart:
    chart.add("bar", x=["a", "b"], y=[1, 2])
page.write(Path("page.html"))
""",
    )
