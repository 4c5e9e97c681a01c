"""Names that the Tab key finishes. A table of a command says which (`names`), see `parameters.py`."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from click import Context, Parameter
from click.shell_completion import CompletionItem

from armctl.errors import ArmctlError
from armctl.files import calibration_dirs, logs_dir, served_socket

# Beside whose names any file may be given.
OR_FILES = ("arms", "robots", "logs", "plans", "recordings")


def complete(kind: str) -> Callable[[Context, Parameter, str], list[CompletionItem]]:
    """What finishes names of a kind."""

    def found(_context: Context, _parameter: Parameter, begun: str) -> list[CompletionItem]:
        items = []
        with suppress(ArmctlError, OSError):  # a shell that waits for names is no place for an error
            items = [CompletionItem(name) for name in sorted(set(_names(kind))) if name.startswith(begun)]
        return items or [CompletionItem(begun, type="file")] * (kind in OR_FILES)

    return found


def _names(kind: str) -> Iterable[str]:
    match kind:
        case "recordings":
            return _stems(logs_dir().with_name(kind), "*.mcap")
        case "plans" | "logs":
            kept, ends = logs_dir().with_name(kind), "*.json" if kind == "plans" else "*.mcap"
            return [str(path) for folder in (Path(), kept) for path in folder.glob(ends)]
        case "joints":
            from armctl.client import Client

            with Client(timeout_s=1.0) as client:
                return [joint["name"] for joint in client.call("status")["joints"]]
        case "faults":
            from armctl.sim.faults import DESCRIPTIONS

            return DESCRIPTIONS
        case "codes":
            from armctl.control.faults import CODES

            return CODES
        case "topics":
            return [*_stems(Path(__file__).parent.parent / "docs", "*.md"), "faults", "configuration"]
        case "services":
            return _stems(Path(served_socket("*")).parent, "*.sock")
    arms = [name for folder in calibration_dirs() for name in _stems(folder, "*.yaml")]
    if kind == "arms":
        return arms
    from armctl.kinematics import robots

    return [*robots.names(), *arms]


def _stems(folder: Path, pattern: str) -> list[str]:
    return [path.stem for path in folder.glob(pattern)]
