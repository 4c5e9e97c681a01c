"""`python -m armctl.proving prove|bench NAME`: what tools/prove and tools/bench run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import click

from armctl.errors import ArmctlError

SEED = 1


def _packets(seed: int) -> dict[str, Any]:
    from armctl.proving import packets

    return packets.prove(seed)


def _wire(seed: int) -> dict[str, Any]:
    from armctl.proving import wire

    return wire.prove(seed, tell=lambda line: click.echo(line, err=True))


def _bus(seed: int) -> dict[str, Any]:
    from armctl.proving import bus_bench

    return bus_bench.bench(seed)


def _jitter(seed: int) -> dict[str, Any]:
    from armctl.proving import jitter_bench

    return jitter_bench.bench(seed)


PROOFS: dict[str, Callable[[int], dict[str, Any]]] = {"packets": _packets, "wire": _wire}
BENCHES: dict[str, Callable[[int], dict[str, Any]]] = {"bus": _bus, "jitter": _jitter}

as_json = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
seeded = click.option("--seed", default=SEED, show_default=True, type=click.IntRange(0), help="Repeats a run.")


@click.group()
def main() -> None:
    """Proofs and benchmarks of armctl."""


@main.command()
@click.argument("name", type=click.Choice(tuple(PROOFS)))
@seeded
@as_json
def prove(name: str, seed: int, as_json: bool) -> None:
    """Run a proof; exit status 1 if anything was violated."""
    result = PROOFS[name](seed)
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
