"""A machine to install on: systemd as the first process of namespaces of its own, over an overlay of this machine.

Rules.
1. Nothing of this machine is written. The new root is an overlay whose upper layer lies in memory; /sys and /proc/sys
   are read-only, /dev has pseudo devices alone, the network has a loopback interface and nothing else, and the clock
   and the kernel's modules are out of reach. Home folders are empty.
2. Its processes are in a cgroup of their own. Killing its first process ends them all: that is what `power_cut` does,
   and what happens when the proof itself is killed.
3. `why_not` says in one line why there can be none here.

Not tried here: udev (no device of the kernel is ever announced), and MemoryMax and TasksMax where the kernel's memory
and pids controllers belong to the older kind of cgroups.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from armctl.errors import ArmctlError

ROOT = Path(__file__).resolve().parents[2]
SYSTEMD = Path("/lib/systemd/systemd")
# In memory, and never below the layer that it covers.
MEMORY = Path("/dev/shm")
TARGET = "proving.target"
# Capabilities that reach beyond namespaces: nothing in the machine has them, the commands that enter it neither.
TAKEN = "-sys_time,-sys_module,-sys_rawio,-syslog,-wake_alarm"
PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
BOOT_S = 30.0
COMMAND_S = 600.0
# What a container's first start may do, and this one is not to: mounts, settings of the kernel, clocks, random seeds.
KEPT = {"systemd-journald.service"}
# $1: folder of the layers, $2: the target, $3: capabilities that everything in the machine goes without. The old root
# is let go: in a chroot there are no user namespaces.
BOOT = """
set -e
mount --make-rprivate /
mount -t overlay overlay -o lowerdir=/,upperdir=$1/upper,workdir=$1/work $1/root
cd $1/root
mount -t proc proc proc
mount -t sysfs -o ro sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs dev
for one in null zero full random urandom tty; do touch dev/$one; mount --bind /dev/$one dev/$one; done
mkdir dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts dev/pts
ln -s pts/ptmx dev/ptmx
mount -t tmpfs tmpfs dev/shm
mount -t tmpfs -o mode=755 tmpfs run
mount -t tmpfs -o mode=1777 tmpfs tmp
for one in root home; do mount -t tmpfs -o mode=755 tmpfs $one; done
mount --bind proc/sys proc/sys
mount -o remount,ro,bind proc/sys
ip link set lo up 2>/dev/null || :
pivot_root . mnt
umount --lazy /mnt
cd /
exec setpriv --bounding-set="$3" env -i container=armctl PATH="$PATH" \
    /lib/systemd/systemd --system --unit="$2" --log-target=journal --show-status=no
"""
# An HTTP request, asked where the loopback interface is the machine's: address, method, headers and body as JSON.
ASK = """
import json, ssl, sys, urllib.error, urllib.request
address, method, headers, body, wait_s = json.loads(sys.stdin.read())
data = None if body is None else json.dumps(body).encode()
headers = {**headers, **({} if data is None else {"content-type": "application/json"})}
request = urllib.request.Request(address, data, headers, method=method)
context = ssl._create_unverified_context() if address.startswith("https") else None
try:
    with urllib.request.urlopen(request, timeout=wait_s, context=context) as answer:
        status, text = answer.status, answer.read()
except urllib.error.HTTPError as error:
    status, text = error.code, error.read()
except OSError as error:
    status, text = 0, str(error).encode()
print(json.dumps([status, text.decode(errors="replace")]))
"""


def why_not() -> str:
    """Why there can be no such machine here, in one line; empty: there can."""
    missing = [
        name for name in ("unshare", "nsenter", "setpriv", "pivot_root", "mount", "runuser") if not shutil.which(name)
    ]
    if os.name != "posix" or sys.platform != "linux":
        return f"this is {sys.platform}, not Linux"
    if not SYSTEMD.exists():
        return "there is no systemd here; install it: sudo apt install systemd"
    if missing:
        return f"there is no {', '.join(missing)} here; install it: sudo apt install util-linux coreutils"
    if os.getuid() != 0:
        return "only root can make the namespaces; run it with sudo"
    if "overlay" not in Path("/proc/filesystems").read_text():
        return "this kernel has no overlay file system"
    if _cgroups() is None:
        return "no file system of kind cgroup2 is mounted here"
    tried = subprocess.run(("unshare", "--mount", "--pid", "--net", "--cgroup", "--fork", "true"), capture_output=True)
    return "" if tried.returncode == 0 else f"no namespaces can be made here: {tried.stderr.decode().strip()}"


def _cgroups() -> Path | None:
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2":
            return Path(place)
    return None


class Machine:
    """One machine; it can be booted, cut off and booted again, and keeps its files over that."""

    def __init__(self, name: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=f"armctl-{name}-", dir=MEMORY))
        for layer in ("upper", "work", "root"):
            (self.folder / layer).mkdir()
        cgroups = _cgroups()
        assert cgroups is not None
        self._cgroup = cgroups / self.folder.name
        self._outer: subprocess.Popen[bytes] | None = None
        self._first = 0
        units = self.folder / "upper" / "etc" / "systemd" / "system"
        units.mkdir(parents=True)
        (units / TARGET).write_text("[Unit]\nWants=multi-user.target\n")
        wants = Path("/lib/systemd/system")
        for target in ("sysinit.target", "multi-user.target", "basic.target", "timers.target", "sockets.target"):
            for folder in (wants, Path("/etc/systemd/system")):
                for unit in (folder / f"{target}.wants").glob("*"):
                    if unit.name not in KEPT and "journald" not in unit.name and not (units / unit.name).is_symlink():
                        (units / unit.name).symlink_to("/dev/null")

    def boot(self) -> None:
        """Start the first process, and wait until it has started what the machine starts by itself.

        Raises:
            ArmctlError: it did not come up.
        """
        self._cgroup.mkdir(exist_ok=True)
        flags = ("--mount", "--pid", "--uts", "--ipc", "--net", "--cgroup", "--fork", "--kill-child")
        enter = 'echo 0 >"$0/cgroup.procs"; exec setpriv --pdeathsig KILL unshare "$@"'
        command = (
            "sh",
            "-c",
            enter,
            str(self._cgroup),
            *flags,
            "sh",
            "-c",
            BOOT,
            "boot",
            str(self.folder),
            TARGET,
            TAKEN,
        )
        log = self.folder / "boot.log"
        with log.open("w") as words:
            self._outer = subprocess.Popen(
                command, env={"PATH": PATH}, stdin=subprocess.DEVNULL, stdout=words, stderr=words
            )
        deadline_s = time.monotonic() + BOOT_S
        while time.monotonic() < deadline_s and self._outer.poll() is None:
            children = Path(f"/proc/{self._outer.pid}/task/{self._outer.pid}/children").read_text().split()
            self._first = int(children[0]) if children else 0
            if self._first and self.run("systemctl", "is-system-running").stdout.strip() in ("running", "degraded"):
                return
            time.sleep(0.1)
        raise ArmctlError(f"the machine did not come up: {log.read_text().strip()[-400:] or 'no word'}")

    @property
    def root(self) -> str:
        """Where this machine sees that one's files."""
        return f"/proc/{self._first}/root"

    def _enter(self, user: str) -> tuple[str, ...]:
        """What comes before a command so that it runs in the machine, with nothing that reaches out of it."""
        spaces = ("--mount", "--pid", "--uts", "--ipc", "--net", "--cgroup", "--root", "--wd")
        clean = ("setpriv", f"--bounding-set={TAKEN}", "env", "-i", f"PATH={PATH}", "LANG=C.UTF-8", "HOME=/root")
        other = ("runuser", "-u", user, "--") if user else ()
        return ("nsenter", f"--target={self._first}", *spaces, *clean, *other)

    def run(
        self, *command: str, user: str = "", said: str | None = None, wait_s: float = COMMAND_S
    ) -> subprocess.CompletedProcess[str]:
        """A command's end, in the machine; as a user if one is named."""
        try:
            return subprocess.run(
                (*self._enter(user), *command), input=said, capture_output=True, text=True, timeout=wait_s
            )
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, 124, "", f"no end after {wait_s:g} s")

    def start(self, *command: str, user: str = "") -> subprocess.Popen[str]:
        """A command that is under way in the machine."""
        pipe = subprocess.PIPE
        return subprocess.Popen((*self._enter(user), *command), stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def must(self, *command: str, user: str = "", said: str | None = None) -> str:
        """What a command printed.

        Raises:
            ArmctlError: it failed.
        """
        done = self.run(*command, user=user, said=said)
        if done.returncode != 0:
            told = (done.stderr or done.stdout).strip()[-400:]
            raise ArmctlError(f"{' '.join(command)}: exit status {done.returncode}: {told}")
        return done.stdout

    def json(self, *command: str, user: str = "") -> dict[str, Any]:
        """The JSON object that a command of armctl printed, whatever its exit status; empty: none."""
        done = self.run(*command, "--json", user=user)
        with contextlib.suppress(ValueError):
            answer: dict[str, Any] = json.loads(done.stdout)
            return answer
        return {}

    def write(self, path: str, text: str) -> None:
        self.must("sh", "-c", 'mkdir -p "$(dirname "$0")" && cat >"$0"', path, said=text)

    def read(self, path: str) -> str:
        return self.run("cat", path).stdout

    def ask(
        self, address: str, method: str = "GET", *, token: str = "", body: Any = None, wait_s: float = 60.0
    ) -> tuple[int, Any]:
        """Status and answer of an HTTP request; status 0: nobody answered."""
        headers = {"x-armctl-token": token} if token else {}
        asked = json.dumps([address, method, headers, body, wait_s])
        status, text = json.loads(self.must("/usr/bin/python3", "-c", ASK, said=asked))
        with contextlib.suppress(ValueError):
            return status, json.loads(text)
        return status, text

    def unit(self, name: str, *properties: str) -> dict[str, str]:
        """Properties of a unit, as systemd has them."""
        lines = self.must("systemctl", "show", name, f"--property={','.join(properties)}").splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def cpu_s(self) -> float:
        """Processor time that all services have taken [s], those that have ended too."""
        told = self.read("/sys/fs/cgroup/system.slice/cpu.stat")
        return next((int(line.split()[1]) / 1e6 for line in told.splitlines() if line.startswith("usage_usec")), 0.0)

    def power_cut(self) -> None:
        """Everything ends at once; what was written stays."""
        if self._outer is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._first, signal.SIGKILL)
        self._outer.wait(10.0)
        self._outer = None

    def reboot(self) -> None:
        """Shut down as systemd does it, then boot."""
        assert self._outer is not None
        self.run("systemctl", "--no-block", "poweroff")
        try:
            self._outer.wait(BOOT_S)
        except subprocess.TimeoutExpired:
            self.power_cut()
            raise ArmctlError(f"the machine did not shut down in {BOOT_S:g} s") from None
        self._outer = None
        self.boot()

    def close(self) -> None:
        """End everything and leave nothing behind."""
        self.power_cut()
        deadline_s = time.monotonic() + 10.0
        while self._cgroup.exists() and time.monotonic() < deadline_s:
            for folder, _, _ in os.walk(self._cgroup, topdown=False):
                with contextlib.suppress(OSError):  # its last process is still on its way out
                    os.rmdir(folder)
            time.sleep(0.05)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextlib.contextmanager
def machine(name: str) -> Iterator[Machine]:
    """A booted machine, ended on leaving.

    Raises:
        ArmctlError: there can be none here; says why.
    """
    if why := why_not():
        raise ArmctlError(f"units: {why}")
    made = Machine(name)
    try:
        made.boot()
        yield made
    finally:
        made.close()


def wheels(folder: Path) -> Path:
    """armctl's own wheel in `folder`, and beside it every package of the extra `web`, fetched once for a checkout.

    Raises:
        ArmctlError: they cannot be built or fetched.
    """
    folder.mkdir(parents=True, exist_ok=True)
    constraints = ROOT / "tools" / "constraints.txt"
    wanted = (ROOT / "pyproject.toml").read_text() + constraints.read_text()
    stamp = folder / "fetched"
    for old in folder.glob("armctl-*.whl"):
        old.unlink()
    build = (sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder))
    steps: list[Sequence[str]] = [build]
    if not stamp.exists() or stamp.read_text() != wanted:
        fetch = ("-m", "pip", "download", "--quiet", "--dest", str(folder), "--constraint", str(constraints))
        steps.insert(0, ("/usr/bin/python3", *fetch, f"{ROOT}[web]"))
    for step in steps:
        done = subprocess.run(step, cwd=ROOT, capture_output=True, text=True)
        if done.returncode != 0:
            raise ArmctlError(f"{' '.join(step)}: {done.stderr.strip()[-400:]}")
    stamp.write_text(wanted)
    return folder
