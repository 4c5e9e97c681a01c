"""`python -m proving prove|bench NAME`: what tools/prove and tools/bench run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import click

from armctl.errors import ArmctlError

SEED = 1


def _packets(seed: int) -> dict[str, Any]:
    from proving import packets

    return packets.prove(seed)


def _wire(seed: int) -> dict[str, Any]:
    from proving import wire

    return wire.prove(seed, tell=lambda line: click.echo(line, err=True))


def _unit(seed: int) -> dict[str, Any]:
    from proving import unit

    return unit.prove(seed)


def _kill(seed: int) -> dict[str, Any]:
    from proving import kill

    return kill.prove(seed, tell=lambda line: click.echo(line, err=True))


def _load(seed: int) -> dict[str, Any]:
    from proving import load

    return load.prove(seed, tell=lambda line: click.echo(line, err=True))


def _powercut(seed: int) -> dict[str, Any]:
    from proving import powercut

    return powercut.prove(seed)


def _straightness(seed: int) -> dict[str, Any]:
    from proving import straightness

    return straightness.prove(seed, tell=lambda line: click.echo(line, err=True))


def _refinement(seed: int) -> dict[str, Any]:
    from proving import straightness

    return straightness.prove_refinement(seed, tell=lambda line: click.echo(line, err=True))


def _soak(seed: int, **options: Any) -> dict[str, Any]:
    from proving import soak

    return soak.prove(seed, tell=lambda line: click.echo(line, err=True), **options)


def _mutants(seed: int, **options: Any) -> dict[str, Any]:
    from proving import mutants

    return mutants.prove(seed, tell=lambda line: click.echo(line, err=True), **options)


def _fuzz(seed: int) -> dict[str, Any]:
    from proving import fuzz

    return fuzz.prove(seed, tell=lambda line: click.echo(line, err=True))


def _log(seed: int) -> dict[str, Any]:
    from proving import log_bench

    return log_bench.bench(seed)


def _bus(seed: int) -> dict[str, Any]:
    from proving import bus_bench

    return bus_bench.bench(seed)


def _gap(seed: int) -> dict[str, Any]:
    from proving import gap

    return gap.prove(seed, tell=lambda line: click.echo(line, err=True))


def _ga(seed: int) -> dict[str, Any]:
    from proving import ga_bench

    return ga_bench.bench(seed)


def _line(seed: int) -> dict[str, Any]:
    from proving import line_bench

    return line_bench.bench(seed)


def _sim(seed: int) -> dict[str, Any]:
    from proving import sim_bench

    return sim_bench.bench(seed)


def _jitter(seed: int) -> dict[str, Any]:
    from proving import jitter_bench

    return jitter_bench.bench(seed)


def _ik(seed: int) -> dict[str, Any]:
    from proving import ik_bench

    return ik_bench.bench(seed)


def _web(seed: int) -> dict[str, Any]:
    from proving import web_bench

    return web_bench.bench(seed)


PROOFS: dict[str, Callable[..., dict[str, Any]]] = {
    "fuzz": _fuzz,
    "soak": _soak,
    "mutants": _mutants,
    "gap": _gap,
    "powercut": _powercut,
    "refinement": _refinement,
    "straightness": _straightness,
    "packets": _packets,
    "wire": _wire,
    "unit": _unit,
    "kill": _kill,
    "load": _load,
}
OPTIONS = {"soak": {"hours", "workers", "episode"}, "mutants": {"workers"}}
"""What a proof takes beside the seed."""
BENCHES: dict[str, Callable[[int], dict[str, Any]]] = {
    "log": _log,
    "web": _web,
    "bus": _bus,
    "sim": _sim,
    "jitter": _jitter,
    "ik": _ik,
    "ga": _ga,
    "line": _line,
}

as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
seeded = click.option("--seed", default=SEED, show_default=True, type=click.IntRange(0), help="Repeats a run.")


@click.group()
def main() -> None:
    """Proofs and benchmarks of armctl."""


@main.command()
@click.argument("name", type=click.Choice(tuple(PROOFS)))
@seeded
@click.option("--hours", type=click.FloatRange(0.0, min_open=True), help="soak: virtual time.")
@click.option("--episode", type=click.IntRange(0), help="soak: this one alone.")
@click.option("--workers", type=click.IntRange(1), help="soak, mutants: processes.  [default: 2]")
@as_json
def prove(name: str, seed: int, as_json: bool, **options: float | int | None) -> None:
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
@as_json
def bench(name: str, seed: int, as_json: bool) -> None:
    """Run a benchmark; its bounds are for an idle machine, so missing one is told and no failure."""
    names = tuple(BENCHES) if name == "all" else (name,)
    results = [BENCHES[one](seed) for one in names]
    result: dict[str, Any] = {
        "rows": [row for one in results for row in one["rows"]],
        "checks": [check for one in results for check in one["checks"]],
        "seed": seed,
    }
    if as_json:
        click.echo(json.dumps(result))
        return
    for row in result["rows"]:
        click.echo(f"{row['work']:<44} {row['who']:<40} {row['value']:9.3f} {row['unit']:<12} x{row['ratio']:.2f}")
    for check in result["checks"]:
        held = "held  " if check["ok"] else "MISSED"
        click.echo(f"{held} {check['name']}: {check['value']:.3f}, bound {check['bound']:g}")


if __name__ == "__main__":
    try:
        main()
    except ArmctlError as error:
        click.echo(str(error), err=True)
        sys.exit(error.exit_status)
