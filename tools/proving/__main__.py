"""`python -m proving prove|bench NAME`, with tools/ on the path: what tools/prove and tools/bench run."""

import importlib
import json
import signal
import sys
from collections.abc import Callable
from typing import Any

import click

from armctl.errors import ArmctlError

SEED = 1


Work = Callable[..., dict[str, Any]]


def _work(module: str, function: str, *, tells: bool = False) -> Work:
    """What a name runs; its module is imported only then, for each needs other peers."""

    def run(seed: int, **options: Any) -> dict[str, Any]:
        if tells:
            options["tell"] = lambda line: click.echo(line, err=True)
        work: Work = getattr(importlib.import_module(f"proving.{module}"), function)
        return work(seed, **options)

    return run


PROOFS: dict[str, Work] = {
    "fuzz": _work("fuzz", "prove", tells=True),
    "soak": _work("soak", "prove", tells=True),
    "mutants": _work("mutants", "prove", tells=True),
    "gap": _work("gap", "prove", tells=True),
    "powercut": _work("powercut", "prove"),
    "replay": _work("replay", "prove", tells=True),
    "refinement": _work("straightness", "prove_refinement", tells=True),
    "straightness": _work("straightness", "prove", tells=True),
    "lines": _work("lines", "prove", tells=True),
    "place": _work("place", "prove", tells=True),
    "jogs": _work("jogs", "prove", tells=True),
    "setup": _work("setting_up", "prove", tells=True),
    "arms": _work("whole_job", "prove", tells=True),
    "identify": _work("identify", "prove", tells=True),
    "calibration": _work("calibration", "prove", tells=True),
    "packets": _work("packets", "prove"),
    "wire": _work("wire", "prove", tells=True),
    "units": _work("units", "prove", tells=True),
    "kill": _work("kill", "prove", tells=True),
    "hang": _work("hang", "prove", tells=True),
    "load": _work("load", "prove", tells=True),
    "page": _work("page", "prove", tells=True),
    "client": _work("client", "prove", tells=True),
    "programs": _work("programs", "prove", tells=True),
}
# What a proof takes beside the seed.
OPTIONS = {
    "soak": {"hours", "workers", "episode", "arm"},
    "mutants": {"workers"},
    "hang": {"runs", "hours"},
    "client": {"runs"},
    "programs": {"runs", "workers"},
    "arms": {"arms", "workers"},
    "identify": {"arms", "workers"},
    "calibration": {"arms", "workers"},
    "lines": {"arms", "classes", "workers"},
    "place": {"arms", "targets", "workers"},
    "jogs": {"arms", "targets", "workers"},
    "replay": {"workers"},
    "setup": {"arms", "workers"},
    "units": {"hours"},
}
BENCHES: dict[str, Work] = {
    name: _work(f"{name}_bench", "bench")
    for name in ("log", "month", "folder", "web", "bus", "sim", "jitter", "ik", "ga", "line", "start")
}

as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
seeded = click.option("--seed", default=SEED, show_default=True, type=click.IntRange(0), help="Repeats a run.")


@click.group()
def main() -> None:
    """Proofs and benchmarks of armctl."""


def _named(_context: click.Context, _option: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    """The classes of lines that an option names."""
    from proving.truth import CLASSES

    names = None if value is None else tuple(value.split(","))
    if names is not None and (unknown := [name for name in names if name not in CLASSES]):
        raise click.BadParameter(f"no class {', '.join(unknown)}; there are {', '.join(CLASSES)}")
    return names


@main.command()
@click.argument("name", type=click.Choice(tuple(PROOFS)))
@seeded
@click.option(
    "--hours", type=click.FloatRange(0.0), help="soak: virtual time; hang: on a busy machine; units: of service."
)
@click.option(
    "--runs", type=click.IntRange(0), help="hang: of each process; client: ends; programs.  [default: 200; 100]"
)
@click.option("--episode", type=click.IntRange(0), help="soak: this one alone.")
@click.option("--arm", help="soak: on this arm, by name.  [default: those shipped first, in turn]")
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="soak, mutants, arms, lines, place, jogs, replay, programs, setup: processes.  [default: 2; setup 1]",
)
@click.option(
    "--arms", type=click.IntRange(1), help="How many; lines, place, jogs: 20, setup: 30, arms: 10 unless told."
)
@click.option("--targets", type=click.IntRange(1), help="place, jogs: how many of each arm.  [default: 20, 10]")
@click.option("--classes", callback=_named, help="lines: which classes, with commas between them.  [default: all]")
@as_json
def prove(name: str, seed: int, as_json: bool, **options: float | int | str | tuple[str, ...] | None) -> None:
    """Run a proof; exit status 1 if anything was violated."""
    given = {option: value for option, value in options.items() if value is not None}
    if unknown := given.keys() - OPTIONS.get(name, set()):
        raise click.UsageError(f"{name} takes no --{' and no --'.join(sorted(unknown))}")
    result = PROOFS[name](seed, **given)
    if as_json:
        click.echo(json.dumps(result))
    else:
        for key, value in result.items():
            for one in value if isinstance(value, list) else (value,):
                text = ", ".join(f"{k} {v}" for k, v in one.items()) if isinstance(one, dict) else str(one)
                click.echo(f"{key}: {text}")
    sys.exit(1 if result["violations"] else 0)


@main.command()
@click.argument("name", type=click.Choice((*BENCHES, "all")))
@seeded
@click.option("--installed", is_flag=True, help="jitter: of the installed service, on a machine booted for it.")
@as_json
def bench(name: str, seed: int, installed: bool, as_json: bool) -> None:
    """Run a benchmark; its bounds are for an idle machine, so missing one is told and no failure, save where the
    benchmark weighs both sides in the same run and says that it is one.
    """
    if installed and name != "jitter":
        raise click.UsageError(f"{name} takes no --installed")
    names = tuple(BENCHES) if name == "all" else (name,)
    results = [BENCHES[one](seed, **({"installed": True} if installed else {})) for one in names]
    result: dict[str, Any] = {
        "rows": [row for one in results for row in one["rows"]],
        "checks": [check for one in results for check in one["checks"]],
        "seed": seed,
    }
    status = int(any(one.get("violations") for one in results))
    if as_json:
        click.echo(json.dumps(result))
        sys.exit(status)
    for row in result["rows"]:
        click.echo(f"{row['work']:<44} {row['who']:<40} {row['value']:9.3f} {row['unit']:<12} x{row['ratio']:.2f}")
    for check in result["checks"]:
        held = "held  " if check["ok"] else "MISSED"
        click.echo(f"{held} {check['name']}: {check['value']:.3f}, bound {check['bound']:g}")
    sys.exit(status)


def run() -> None:
    """The command; what cannot be done is told in one sentence, and SIGTERM ends what was started as well."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        main()
    except ArmctlError as error:
        click.echo(str(error), err=True)
        sys.exit(error.exit_status)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("armctl", "proving"):
            raise  # a mistake of our own, no missing peer
        peer = error.name.split(".")[0]
        click.echo(
            f"{peer}, which this compares with or looks by, is not installed: pip install 'armctl[test]'", err=True
        )
        sys.exit(1)


if __name__ == "__main__":
    run()
