"""armctl as it is installed on a machine (`machine.py`), the simulated arm behind its port, and what both say."""

import contextlib
import json
import shutil
import socket
import time
from collections.abc import Callable, Container, Iterator
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from armctl.errors import ArmctlError
from proving.machine import ROOT, Machine, wheels

ARMCTL = "/opt/armctl/bin/armctl"
PACKAGES = "/opt/packages"
WEB = "http://127.0.0.1:8080"
# Where the adapter's name leads; without an adapter it leads nowhere.
PORT = "/dev/arm/servos"
LOGS = "/var/lib/armctl/logs"
DAEMON = "armctl.service"
DASHBOARD = "armctl-web.service"
# The simulated arm, as a program of the user whose group may use an adapter.
SIMULATOR = f"""[Service]
Type=exec
User=armctl
Group=armctl
# Real servos wait for no other program.
Nice=-15
AmbientCapabilities=CAP_SYS_NICE
ExecStart={ARMCTL} sim --link %s --seed %d
"""
FROM_M, TO_M = (0.18, -0.125, 0.10), (0.18, 0.125, 0.10)
# As much as the arm may move while only programs come and go: sag, play and noise of a servo.
STILL_RAD = 0.01
ANSWER_S = 20.0
# Counts the messages of a log that hold a word, as far as the log is written.
COUNT = """
import sys
from mcap.records import Message
from mcap.stream_reader import StreamReader
found = 0
log = open(sys.argv[1], "rb")
try:
    for record in StreamReader(log).records:
        found += isinstance(record, Message) and sys.argv[2].encode() in record.data
except Exception:
    pass
print(found)
"""


class Installed:
    """One machine on which armctl is to be installed by what the README says, and served for `lasts_s` in one go."""

    def __init__(self, machine: Machine, seed: int, lasts_s: float = 0.0) -> None:
        self.machine, self.seed, self.lasts_s = machine, seed, lasts_s
        self.token = ""
        # What the commands of the README took, one entry a command [s].
        self.steps: list[tuple[str, float]] = []

    # ------------------------------------------------------------------------------------------------- installing

    def step(self, *command: str) -> None:
        """One command of a newcomer; timed."""
        begin_s = time.monotonic()
        self.machine.must(*command)
        self.steps.append((" ".join(command), time.monotonic() - begin_s))

    def fetch(self) -> None:
        """The environment; its packages come from a folder of wheels, since the machine has no network."""
        shutil.copytree(wheels(ROOT / ".venv" / "units"), f"{self.machine.root}{PACKAGES}")
        self.step("python3", "-m", "venv", "/opt/armctl")
        pip = ("/opt/armctl/bin/pip", "install", "--quiet", "--no-index", "--disable-pip-version-check")
        self.step(*pip, "--find-links", PACKAGES, "armctl[web]")

    def upgrade(self) -> None:
        """The same wheel once more, as a newer one is installed."""
        pip = ("/opt/armctl/bin/pip", "install", "--quiet", "--no-index", "--disable-pip-version-check")
        self.machine.must(*pip, "--find-links", PACKAGES, "--no-deps", "--force-reinstall", "armctl")

    def install(self, *options: str) -> tuple[int, str]:
        """Exit status and words of `armctl install`."""
        done = self.machine.run(ARMCTL, "install", *options)
        return done.returncode, done.stdout + done.stderr

    # --------------------------------------------------------------------------------------------------- the arm

    def simulate(self, port: str = PORT, name: str = "proving-arm") -> None:
        """Start the simulated arm; its adapter is plugged in."""
        folder = port.rpartition("/")[0]
        self.machine.must("install", "-d", "-o", "armctl", "-g", "armctl", folder)
        self.machine.write(f"/run/systemd/system/{name}.service", SIMULATOR % (port, self.seed))
        if port == PORT:
            self.machine.must("ln", "-sfn", PORT, "/dev/armctl")
        self.machine.must("systemctl", "daemon-reload")
        self.machine.must("systemctl", "start", name)
        until(lambda: self.machine.run("test", "-e", port).returncode == 0, "the simulator's port")

    def arm(self, method: str, *, port: str = PORT, params: dict[str, Any] | None = None) -> dict[str, Any]:
        """What the simulator answers on its own socket."""
        answer = _asked(self._inside(f"{port}.control"), {"method": method, "params": params or {}})
        if "error" in answer:
            raise ArmctlError(f"simulator: {answer['error']}")
        result: dict[str, Any] = answer["result"]
        return result

    def joints_rad(self) -> list[float]:
        """Where the arm truly is."""
        joints: list[float] = self.arm("state")["joints_rad"]
        return joints

    def moved_rad(self, before_rad: list[float]) -> float:
        """How far the joint that moved most is from where it was."""
        return max(abs(now - then) for now, then in zip(self.joints_rad(), before_rad, strict=True))

    # ------------------------------------------------------------------------------------------------ the daemon

    def call(self, method: str, at: str = "/run/armctl/armctl.sock", **params: Any) -> dict[str, Any]:
        """The daemon's answer to root.

        Raises:
            ArmctlError: it refused, or nobody answers.
        """
        line = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        answer = _asked(self._inside(at), line)
        if "error" in answer:
            raise ArmctlError(f"{method}: {answer['error']['message']}")
        result: dict[str, Any] = answer["result"]
        return result

    def state(self, at: str = "/run/armctl/armctl.sock") -> str:
        """The arm's state; `none` where no daemon answers."""
        try:
            return str(self.call("status", at)["state"])
        except (ArmctlError, OSError):
            return "none"

    def acknowledge(self) -> None:
        """Clear a fault as a person would: a machine that is busy with other work latches one, at any time."""
        until(self._clear, "an end of the fault")

    def _clear(self) -> bool:
        with contextlib.suppress(ArmctlError, OSError):
            if self.call("status")["fault"] is not None:
                self.call("clear")
            return bool(self.call("status")["fault"] is None)
        return False

    def holding(self) -> None:
        """Bring the arm to hold, whatever it did before."""
        self.acknowledge()
        if self.state() != "holding":
            self.call("torque_on")

    def main_pid(self, unit: str = DAEMON) -> int:
        return int(self.machine.unit(unit, "MainPID")["MainPID"])

    def children(self, pid: int) -> list[int]:
        return [int(word) for word in self.machine.read(f"/proc/{pid}/task/{pid}/children").split()]

    def policy(self) -> str:
        """By which the kernel schedules the control process; 1: SCHED_FIFO."""
        [control] = self.controls(self.main_pid())
        return self.machine.read(f"/proc/{control}/stat").rpartition(")")[2].split()[38]

    def precedence(self) -> str:
        """Niceness of the daemon's session, by which Linux weighs it against other sessions."""
        return self.machine.read(f"/proc/{self.main_pid()}/autogroup").split()[-1]

    @contextlib.contextmanager
    def in_real_time(self) -> Iterator[str]:
        """The service with the priority that its unit asks for, and how it comes to it, if not by that alone.

        Root of this machine may not be allowed to raise a limit. That nothing else of the unit is in the way is seen
        with a capability.
        """
        if self.machine.run("prlimit", "--rtprio=10:10", "true").returncode == 0:
            yield ""
            return
        drop_in = f"/run/systemd/system/{DAEMON}.d/proving.conf"
        nice = "[Service]\nCapabilityBoundingSet=CAP_SYS_NICE\nAmbientCapabilities=CAP_SYS_NICE\n"
        self.machine.write(drop_in, nice)
        self.renew()
        try:
            yield ", with CAP_SYS_NICE: no limit can be raised here"
        finally:
            self.machine.must("rm", drop_in)
            self.renew()

    def renew(self) -> None:
        """Start the daemon anew with its unit as it stands now."""
        self.machine.must("systemctl", "daemon-reload")
        self.machine.must("systemctl", "restart", DAEMON)
        until(lambda: self.state() != "none", "the daemon", 20.0)

    def controls(self, pid: int) -> list[int]:
        """The control process of a daemon, not the jobs beside it."""
        return [one for one in self.children(pid) if "armctl.control" in self.machine.read(f"/proc/{one}/cmdline")]

    def restarts(self, unit: str = DAEMON) -> int:
        return int(self.machine.unit(unit, "NRestarts")["NRestarts"])

    def journal(self, unit: str = DAEMON) -> list[str]:
        return self.machine.run("journalctl", "--no-pager", "--output=cat", f"--unit={unit}").stdout.splitlines()

    def logged(self, word: str) -> int:
        """Messages of all logs that hold a word, in whatever piece of a file that is not finished yet."""
        under_way = self.call("log")["path"]
        return int(self.machine.must("/opt/armctl/bin/python", "-c", COUNT, under_way, word))

    def messages(self, topic: str, *, but: Container[str]) -> Iterator[tuple[int, Any]]:
        """Times [ns] and messages of a topic in all finished logs but some, as mcap-ros2-support reads them.

        Beside them stand their index, and copies of the seconds about a fault.
        """
        for name in self.folder(LOGS):
            if name.startswith("armctl-") and name.endswith(".mcap") and name not in but:
                with open(self._inside(f"{LOGS}/{name}"), "rb") as stream:
                    reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
                    for _, _, message, one in reader.iter_decoded_messages(topics=[topic]):
                        yield message.log_time, one

    def folder(self, path: str) -> list[str]:
        """Names in a folder, by name."""
        return sorted(self.machine.run("ls", "-1A", path).stdout.split())

    # --------------------------------------------------------------------------------------------- the dashboard

    def ask(
        self, path: str, body: Any = None, *, method: str = "", token: str | None = None, wait_s: float = 60.0
    ) -> Any:
        """Status and answer of a request to the dashboard."""
        used = self.token if token is None else token
        return self.machine.ask(
            f"{WEB}/api{path}", method or ("GET" if body is None else "POST"), token=used, body=body, wait_s=wait_s
        )

    def local_token(self) -> str:
        """The token for people of this machine, read as the docs say."""
        return self.machine.read("/run/armctl-web/address").strip().partition("#token=")[2]

    def dashboard(self) -> None:
        """Start the dashboard, and wait until it answers with the local token."""
        self.machine.must("systemctl", "start", DASHBOARD)
        until(lambda: self.machine.ask(f"{WEB}/")[0] == 200, "the dashboard's page")
        self.token = self.local_token()

    def _inside(self, path: str) -> str:
        return f"{self.machine.root}{path}"


def _asked(path: str, message: dict[str, Any]) -> dict[str, Any]:
    """The answer to one line on a Unix socket; notifications are passed over."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.settimeout(ANSWER_S)
        asking.connect(path)
        asking.sendall(json.dumps(message).encode() + b"\n")
        with asking.makefile("rb") as lines:
            for line in lines:
                answer: dict[str, Any] = json.loads(line)
                if "result" in answer or "error" in answer:
                    return answer
    raise ArmctlError(f"{path}: closed without an answer")


def until(there: Callable[[], bool], what: str, within_s: float = 30.0) -> float:
    """Wait for something; how long it took [s].

    Raises:
        ArmctlError: it did not come.
    """
    begin_s = time.monotonic()
    while not there():
        if time.monotonic() - begin_s > within_s:
            raise ArmctlError(f"{what} did not come within {within_s:g} s")
        time.sleep(0.1)
    return time.monotonic() - begin_s


@contextlib.contextmanager
def written(machine: Machine, path: str, text: str) -> Iterator[None]:
    """A file with another text, as long as inside."""
    before = machine.read(path)
    machine.write(path, text)
    try:
        yield
    finally:
        machine.write(path, before)
