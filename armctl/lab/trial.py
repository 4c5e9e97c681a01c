"""An arm to try, without one: simulated servos, the daemon, the dashboard, and a hand that guides the limp arm.

All are programs of their own, as they would be with a real arm. What is recorded and learnt stays in one folder.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from armctl.client import Client
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.lab.demo import Ends, line_in_reach, start, started
from armctl.lab.stage import Stage
from armctl.sim.control import SimulatorClient, control_path

# States in which the arm bears its own weight.
HOLDS = ("holding", "moving", "jogging")


class Trial:
    """What runs."""

    def __init__(
        self, address: str, snapshots: Iterator[dict[str, Any]], servos: SimulatorClient, line: Ends | None
    ) -> None:
        # Of the dashboard, with the token that opens it.
        self.address = address
        # What the hand guides the arm along [m]; None: nothing of it is in reach.
        self.line = line
        self._snapshots, self._servos = snapshots, servos
        self._takes, self._holds = 0, False

    def serve(self, pressed: Callable[[], str], say: Callable[[str], None]) -> None:
        """Let the hand guide the limp arm whenever a key is pressed, and let go once the arm holds itself. Never ends.

        Args:
            pressed: The key that was pressed since it was last asked; empty: none.
            say: Takes what a person is to know.
        Raises:
            ArmctlError: the daemon or the simulator is gone.
        """
        for snapshot in self._snapshots:
            state = snapshot["state"]
            if self._holds and state in HOLDS:
                self._servos.let_go()
                self._holds = False
                say("the hand lets go: the arm holds itself")
            if pressed():
                say(self._guide() if state == "teaching" else f"the arm is {state}: begin to teach, then press again")

    def _guide(self) -> str:
        if self.line is None:
            return "no line is in this arm's reach; `armctl hand --from X,Y,Z --to X,Y,Z` takes another one"
        try:
            guided = self._servos.guide(self.line[0], self.line[1], seed=self._takes)
        except RequestRefused as refused:
            return str(refused)
        self._takes, self._holds = self._takes + 1, True
        return f"the hand carries the tool to the start and leads it along the line: {guided.duration_s:.0f} s"


@contextmanager
def trial(folder: Path, arm: str, socket: Path, link: Path, port: int, stage: Stage) -> Iterator[Trial]:
    """Start everything; it is ended on leaving.

    Args:
        folder: For logs, recordings, plans and what is learnt of the arm; what an earlier trial left is moved aside.
        socket: The daemon's.
        link: Of the simulated servos' port.
        port: Of the dashboard.
    Raises:
        ArmctlError: one of the programs did not start; its last message is in the error.
        ConfigError: there is no such arm.
    """
    played = load_arm(arm)
    with ExitStack() as cleanup:
        with stage("starting", 3) as show:
            common = start(cleanup, arm, folder / f"{played.arm_id}.yaml", link, socket, show)
            _, address = cleanup.enter_context(started(folder / "web.log", "web", "--port", str(port), *common))
            show(3, "dashboard")
        snapshots = cleanup.enter_context(Client(socket)).subscribe()
        hand = cleanup.enter_context(SimulatorClient(control_path(link)))
        yield Trial(address, snapshots, hand, line_in_reach(played))
