"""`armctl report`: one file for a bug report."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from armctl.cli.output import Output, config_option, output_option


@click.command("report")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="The zip file to write.")
@config_option
@output_option
def report_command(output: Output, out: Path | None, config_file: str | None) -> None:
    """Gather versions, doctor, status, configuration and the last logs into one zip file for a bug report.

    Secrets, your name and your home folder are left out of every text; look through the file before you send it.

    Example: armctl report --out armctl-report.zip
    """
    from armctl.commissioning import bundle
    from armctl.files import load_config

    path = out or Path(f"armctl-report-{datetime.now():%Y%m%d-%H%M%S}.zip")
    files = bundle.write(path, load_config(config_file), config_file or "", lambda part: output.say(f"  {part}"))
    if not output.result({"path": str(path), "files": files}):
        output.say(f"{path}: {len(files)} files, {path.stat().st_size / 1e6:.1f} MB")
