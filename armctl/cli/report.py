"""`armctl report`: one file for a bug report."""

from datetime import datetime
from pathlib import Path

import click

from armctl.cli.output import CONFIG, FILE, Output, command


@command("report", CONFIG)
@click.option("--out", type=FILE, help="The zip file to write.")
def report_command(output: Output, out: Path | None) -> None:
    """Gather versions, doctor, status, configuration and the last logs into one zip file for a bug report.

    Secrets, your name and your home folder are left out of every text; look through the file before you send it.

    Example: armctl report --out armctl-report.zip
    """
    from armctl.commissioning import bundle

    path = out or Path(f"armctl-report-{datetime.now():%Y%m%d-%H%M%S}.zip")
    files = bundle.write(path, output.config, output.config_file or "", lambda part: output.say(f"  {part}"))
    size_MB = path.stat().st_size / 1e6
    output.answer({"path": str(path), "files": files}, f"{path}: {len(files)} files, {size_MB:.1f} MB")
