"""`armctl install` and `armctl uninstall`: the daemon as a service of the system."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armctl.cli.output import FOLDER, Output, command

if TYPE_CHECKING:
    from armctl.commissioning.installation import Act


DRY_RUN = click.Option(["--dry-run"], is_flag=True, help="Say what would be done, and do nothing.")
ROOT = click.Option(
    ["--root"], type=FOLDER, default=Path("/"), help="Write below this folder and run no command: for packages."
)


@command("install", DRY_RUN, ROOT)
@click.option("--arm", default="ax12-line", metavar="NAME|FILE", help="Which arm to serve.")
@click.option("--port", metavar="PATH", help="Serial port of the arm, to limit the udev rule to its adapter.")
@click.option("--user", help="Who may command the arm.  [default: you]")
@click.option("--prefix", type=FOLDER, help="Environment whose bin/armctl the service starts.  [default: this one]")
def install_command(
    output: Output, arm: str, port: str | None, user: str | None, prefix: Path | None, dry_run: bool, root: Path
) -> int:
    """Make the daemon a service that starts with the system.

    Says what it does, changes nothing the second time, and keeps configuration and calibrations that are there.
    The dashboard's service is installed too, but starts only when asked:
    `sudo systemctl enable --now armctl-web`.

    Example: sudo armctl install --port /dev/ttyUSB0
    """
    from armctl.commissioning.installation import SYSTEM, installation, missing_commands
    from armctl.errors import ConfigError

    user = os.environ.get("SUDO_USER", "") if user is None else user
    acts = installation(arm=arm, port=port or "", user=user, prefix=prefix)
    missing = missing_commands(acts) if root == SYSTEM and not dry_run else []
    if missing:
        raise ConfigError(
            "armctl install", "", f"this system has no {', '.join(missing)}", "run `armctl daemon` by hand instead"
        )
    done = "armctl runs as a service; see `armctl status`" if root == SYSTEM else f"written below {root}"
    return _carry_out(output, acts, root, dry_run, done)


@command("uninstall", DRY_RUN, ROOT)
def uninstall_command(output: Output, dry_run: bool, root: Path) -> int:
    """Remove the service; configuration, calibrations, logs and recordings stay.

    The arm comes to rest and keeps its torque: type `armctl park` first to have it limp at its rest pose.

    Example: sudo armctl uninstall --dry-run
    """
    from armctl.commissioning.installation import removal

    return _carry_out(output, removal(), root, dry_run, "left: /etc/armctl, /var/lib/armctl, the user and group armctl")


def _carry_out(output: Output, acts: Sequence[Act], root: Path, dry_run: bool, done: str) -> int:
    from armctl.commissioning.installation import carry_out

    told: list[dict[str, object]] = []

    def tell(act: Act, due: bool) -> None:
        told.append({"act": str(act), "due": due})
        output.say(("would " if dry_run and due else "") + str(act) + ("" if due else "  (nothing to do)"))

    if dry_run:
        for act in acts:
            tell(act, act.due(root))
    else:
        carry_out(acts, root, tell)
        output.say(done)
    output.result({"acts": told, "done": not dry_run})
    return 0
