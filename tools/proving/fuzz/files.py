"""Configurations and recording names."""

import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armctl.config import ArmConfig, Config, LogConfig, parse_yaml, validate
from armctl.errors import ConfigError, LogError, RequestRefused
from armctl.files import load_arm
from armctl.host import plans
from armctl.recording import recordings
from armctl.recording.writer import LogWriter
from armctl.sim import faults
from proving.fuzz import malformed
from proving.fuzz.tally import Memory, Tally
from proving.log_rig import ARM, log_context, simulated_records

TAKES = ("a", "line-1")


class Takes:
    """A folder of recordings that is put back in order now and then."""

    def __init__(self, template: Path, folder: Path) -> None:
        writer = LogWriter(template / f"{TAKES[0]}.mcap", log_context())
        for record in simulated_records(1, 30):
            writer.write_tick(record)
        writer.close()
        self._template, self._folder = template, folder
        self.restore()

    def restore(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(exist_ok=True)  # a daemon that records meanwhile has made it again
        for take in TAKES:
            shutil.copyfile(self._template / f"{TAKES[0]}.mcap", self._folder / f"{take}.mcap")


def yaml_files(seed: int, count: int, tally: Tally) -> None:
    """Configurations, calibrations and fault scripts."""
    rng = random.Random(seed)
    readers: dict[str, Callable[[str], object]] = {
        "arm": lambda text: validate(ArmConfig, parse_yaml(text, "FILE"), "FILE"),
        "config": lambda text: validate(Config, parse_yaml(text, "FILE"), "FILE"),
        "faults": lambda text: faults.parse(text, "FILE", (1, 2, 3)),
    }
    valid = [("config", _config_tree()), ("faults", _faults_tree()), ("arm", _arm_tree())]
    memory = Memory()
    for run in range(count):
        kind, text = malformed.yaml_text(rng, valid)
        begin_s = time.process_time()
        try:
            readers[kind](text)
            tally.outcomes["read"] += 1
        except ConfigError as error:
            tally.outcomes["refused"] += 1
            if not str(error).startswith("FILE"):
                tally.violation(f"{error} does not name the file")
        except Exception as error:
            tally.violation(f"{kind}: {type(error).__name__}: {error} of {text[:200]!r}")
        tally.took(time.process_time() - begin_s, f"{kind}: {text[:60]!r}... ({len(text)} characters)")
        if run == count // 10:
            memory.mark()
    tally.runs += count
    memory.judge(tally)


def _config_tree() -> dict[str, Any]:
    return {**Config(port="/dev/ttyUSB0").model_dump(mode="json"), "log": LogConfig().model_dump(mode="json")}


def _faults_tree() -> dict[str, Any]:
    return {
        "faults": [
            {"kind": "lost", "servo_id": 3, "probability": 0.2, "begin_s": 5, "duration_s": 10},
            {"kind": "late", "count": 1, "value": 12},
            {"kind": "dead_bus", "begin_s": 1.5},
        ]
    }


def _arm_tree() -> dict[str, Any]:
    tree: dict[str, Any] = load_arm(ARM).model_dump(mode="json", exclude_none=True)
    return {**tree, "joints": tree["joints"][:2]}


def recording_names(seed: int, count: int, tally: Tally, folder: Path) -> None:
    """Names as requests bring them, to everything that makes a path of one."""
    rng = random.Random(seed)
    inside, outside = folder / "in", folder / "out"
    takes = Takes(folder / "template", inside)
    outside.mkdir()
    (outside / "secret.mcap").write_bytes(b"secret")
    (outside / "secret.json").write_text("{}")
    ways: dict[str, Callable[[str, str], object]] = {
        "find": lambda name, _: recordings.find(inside, name),
        "rename from": lambda name, other: recordings.rename(inside, name, other),
        "rename to": lambda name, _: recordings.rename(inside, TAKES[0], name),
        "delete": lambda name, _: recordings.delete(inside, name),
        "save": lambda name, _: plans.save(inside / "plans", name, "{}"),
        "load": lambda name, _: plans.load(inside / "plans", name),
        "forget": lambda name, _: plans.delete(inside / "plans", name),
    }
    for run in range(count):
        if run % 200 == 0:
            takes.restore()
        way = rng.choice(list(ways))
        name, other = malformed.name(rng), malformed.name(rng)
        if rng.random() < 0.2:
            name = rng.choice((*TAKES, "../out/secret", "/etc/hostname", f"{outside}/secret"))
        begin_s = time.process_time()
        try:
            ways[way](name, other)
            tally.outcomes[f"{way}: done"] += 1
        except (LogError, RequestRefused, ConfigError):
            tally.outcomes[f"{way}: refused"] += 1
        except Exception as error:
            tally.violation(f"{way} {name!r}, {other!r}: {type(error).__name__}: {error}")
        tally.took(time.process_time() - begin_s, f"{way} {name!r}")
        if run % 1000 == 0 or run == count - 1:
            _untouched(folder, inside, tally)
    tally.runs += count


def _untouched(folder: Path, inside: Path, tally: Tally) -> None:
    """Whether there is nothing but what was there, and inside nothing with a strange name."""
    around = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if inside not in path.parents)
    if around != ["in", "out", "out/secret.json", "out/secret.mcap", "template", "template/a.mcap"]:
        tally.violation(f"outside of its folder: {around}")
    for path in inside.rglob("*"):
        if not path.name.replace("-", "a").replace("_", "a").replace(".", "a").isalnum() or not path.name.isascii():
            tally.violation(f"a file named {path.name!r}")
