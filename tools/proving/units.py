"""The service as it is really installed: a machine is booted, and what people and accidents do to it is tried there.

A story is one claim. It is told with what was seen; one that cannot be brought to its end is a violation too. Stories
run in the order in which they stand, on one machine: first what a newcomer does, then accidents, last the removal. The
claims that need no machine (`service_words`) come first.
"""

import time
from collections.abc import Iterator
from typing import Any

from proving import service_words, unit_accidents, unit_job
from proving.installed import Installed
from proving.machine import machine
from proving.unit_story import SHORT, STORIES, Story, Tell

# Where the stories stand, in this order.
ROOMS = (unit_job, unit_accidents)


def prove(seed: int, tell: Tell = lambda _: None, *, hours: float = 0.1) -> dict[str, Any]:
    """Every story once; `violations` counts the claims that do not hold, `steps` is what a newcomer typed.

    Args:
        hours: How long the service is watched while nobody interferes with it.
    """
    checks = [*service_words.units(), *service_words.protocol(seed)]
    steps = []
    with machine("units") as booted:
        installed = Installed(booted, seed, 3600.0 * hours)
        checks += list(told(installed, STORIES, tell))
        steps = [f"{took_s:.1f} s: {command}" for command, took_s in installed.steps]
    violated = [check["name"] for check in checks if not check["ok"]]
    return {
        "runs": len(checks), "violations": len(violated), "checks": checks, "violated": violated, "steps": steps,
        "seed": seed,
    }  # fmt: skip


def short(seed: int) -> list[dict[str, Any]]:
    """The short form: what a newcomer does, on a machine of its own."""
    with machine("units") as booted:
        return list(told(Installed(booted, seed), [one for one in STORIES if one[0] in SHORT], lambda _: None))


def told(installed: Installed, stories: list[tuple[str, Story]], tell: Tell) -> Iterator[dict[str, Any]]:
    for name, function in stories:
        begin_s = time.monotonic()
        try:
            ok, value = function(installed)
        except Exception as error:  # whatever it is, the claim was not seen to hold
            ok, value = False, f"{type(error).__name__}: {error}; {_words(installed)}"
        tell(f"{'held  ' if ok else 'BROKEN'} {time.monotonic() - begin_s:5.1f} s  {name}: {value}")
        yield {"name": name, "ok": bool(ok), "value": str(value)[:300]}


def _words(installed: Installed) -> str:
    """What the daemon says of its arm, for whoever reads why a story broke off."""
    try:
        status = installed.call("status")
        return f"{status['state']}, {[fault['text'] for fault in status['faults']]}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
