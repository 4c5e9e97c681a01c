"""What users get beside the wheel: the lock, the bill of materials, and the workflow that makes a release."""

import importlib.util
import json
import re
import tomllib
from pathlib import Path
from types import ModuleType

import yaml

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = ROOT / "armctl" / "report" / "plotly.js"
PAGE = ROOT / "tools" / "packaging" / "page"
LOCK = (ROOT / "tools" / "packaging" / "lock.txt").read_text(encoding="utf-8")


def sbom() -> ModuleType:
    spec = importlib.util.spec_from_file_location("sbom", ROOT / "tools" / "packaging" / "sbom.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def bundled() -> list[str]:
    """Name and version of each package of which something is in a library of a page."""
    lock = json.loads((PAGE / "package-lock.json").read_text())["packages"]
    places = json.loads((PAGE / "bundled.json").read_text())
    return [f"{place.rpartition('node_modules/')[2]} {lock[place]['version']}" for place in places]


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_that_users_get_is_locked_with_hashes_and_at_the_tested_version() -> None:
    locked = {plain(name): found for name, found in sbom().locked(LOCK).items()}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["web"], *extras["export"], *extras["live"]]
    assert {plain(re.split(r"[^\w.-]", one)[0]) for one in wanted} <= locked.keys()
    assert all(digests for _, digests in locked.values())
    lines = (ROOT / "tools" / "constraints.txt").read_text().splitlines()
    tested = {plain(name): version for name, _, version in (line.partition("==") for line in lines) if version}
    other = {name: version for name, (version, _) in locked.items() if tested.get(name, version) != version}
    assert other == {}


def test_the_lock_names_no_host() -> None:
    assert not re.search(r"https?:|file:|index-url|find-links", LOCK)


def test_the_bill_of_materials_lists_the_lock() -> None:
    bill = sbom().bill("1.2.3", "abc", LOCK)
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    refs = [part["bom-ref"] for part in bill["components"]]
    assert len(set(refs)) == len(refs) == len(sbom().locked(LOCK)) + len(bundled()) > 35
    direct = json.loads((PAGE / "package.json").read_text())["dependencies"]
    assert {f"pkg:npm/{name}@{version}" for name, version in direct.items()} <= set(refs)
    assert bill["dependencies"][0]["dependsOn"] == sorted(refs)
    assert bill["metadata"]["component"]["properties"] == [{"name": "commit", "value": "abc"}]
    assert all(part["hashes"] for part in bill["components"])


def test_the_library_of_reports_carries_the_licence_of_everything_in_it() -> None:
    told = re.findall(r"^/\*! (\S+ [\d.]+), (\S+)\n(.+?)\n\*/$", LIBRARY.read_text(), re.MULTILINE | re.DOTALL)
    of_the_dashboard = ("three", "uplot")
    assert sorted(name for name, *_ in told) == [one for one in bundled() if not one.startswith(of_the_dashboard)]
    assert {licence for _, licence, _ in told} <= {"MIT", "BSD-3-Clause", "Zlib"}


def test_a_release_is_tested_attested_and_published_without_a_password() -> None:
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    jobs = yaml.safe_load(text)["jobs"]
    used = [step.get("uses", "") for job in jobs.values() for step in job["steps"]]
    assert any(one.startswith("actions/attest-build-provenance@") for one in used)
    assert any(one.startswith("pypa/gh-action-pypi-publish@") for one in used)
    assert jobs["publish"]["needs"] == "build"
    assert "secrets." not in text
    programs = re.findall(r"\btools/[\w/.]+", text)
    assert {"tools/test", "tools/prove"} <= set(programs)
    assert all((ROOT / program).exists() for program in programs)
