"""`armctl experiment`: the paper's experiments on this arm, or on a virtual one."""

from typing import Any

import click

from armctl.cli.output import ARM, CONFIG, HOLDS, SOCKET, Output, command
from armctl.cli.parameters import tables
from armctl.cli.tables import below, show_rows
from armctl.errors import ConfigError


@click.group("experiment")
def experiment_command() -> None:
    """Experiments that measure how straight this arm can be made to move.

    Example: armctl experiment line --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --virtual
    """


@command("line", SOCKET, CONFIG, ARM, group=experiment_command)
def line_command(output: Output, virtual: bool, **asked: Any) -> None:
    """The straight line from A to B with so many intermediate points: before and after correction.

    Every plan is run as it is, then with what the arm's sag model predicts, then corrected by what was measured, and
    the best is repeated. On an arm the daemon must run and hold, and Ctrl-C stops the arm; --virtual needs neither.

    Example: armctl experiment line --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10 --via 0,1,2,8,stream --refine 5
    --virtual
    """
    from armctl.lab.line_experiment import Asked, on_daemon, on_virtual_arm
    from armctl.lab.rig import DaemonRig
    from armctl.sim.twin import load_twin

    for option, (name, why) in tables("experiment")["virtual"].items():
        if asked[name] is not None and not virtual:
            raise ConfigError("armctl experiment", option, why, "leave it out")
    if not virtual:
        output.follow_daemon()
    config, arm = output.config, output.arm
    period_s, spec_file = asked.pop("period_s"), asked.pop("spec_file")
    twin = None if spec_file is None else load_twin(spec_file, arm)
    asked |= {"geometry": asked["geometry"] or "perfect", "age": asked["age"] or "new"}
    wanted = Asked(**asked, twin=twin)
    if virtual:
        result = on_virtual_arm(arm, wanted, period_s or config.period_s, config, output.progress)
    else:
        output.after_interrupt = f"{HOLDS}; recordings of the runs so far are kept"
        with output.client() as client:
            result = on_daemon(DaemonRig(client, arm), wanted, config, output.progress)
    output.answer(result, lambda: show(output, result))


def show(output: Output, result: dict[str, Any]) -> None:
    from armctl.report.line import PRINTED

    rounds = {row["via"]: corrected["round"] for corrected in result["refined"] for row in corrected["rows"]}
    rows = []
    for row, before in zip(result["rows"], result["before"], strict=True):
        corrected = {"before": before, "rounds": rounds[row["via"]], "repeated": row["runs"] > 1}
        rows.append({**row, **corrected, "paper": PRINTED.get(row["via"])})
    show_rows(output.console, "experiment", "Distance of the tool from the line, mean / maximum, mm", rows)
    if (ga := result["ga"]) is not None:
        found = f"{ga['mean_error_mm']:.2f} mm mean on their own points, {ga['gap_ratio']:.2%} above the exact optimum"
        output.say(f"Genetic algorithm over {len(ga['baseline'])} recordings: {found}.")
    if result["report"] is not None:
        output.say(f"Drawn in {result['report']}")
    output.say(below("experiment", {"unseen": max(one["zero_offset_mm"] for one in result["unseen"].values())}))
