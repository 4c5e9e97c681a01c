"""How late ticks come, and what the daemon costs when nothing happens.

Lateness is measured by the control process itself, at its own absolute deadlines, on a simulated arm in another
process: idle, and with one busy process a core beside it (no priority, no real-time class: what a laptop gives).
"""

import contextlib
import multiprocessing
import os
import select
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from armctl.control.link import StartFailed
from armctl.control.process import ControlProcess, ControlSettings
from armctl.errors import ArmctlError
from armctl.files import load_arm
from armctl.lab.demo import started
from armctl.messages import TickRecord
from proving.figures import Row, check, row
from proving.installed import DAEMON, LOGS, Installed, until
from proving.machine import machine
from proving.rig import ARM, rig

SECONDS = 20.0
RATES_HZ = (10, 100)
# Left out at the begin: imports, first keyframe, adoption.
SETTLE_S = 1.0
IDLE_BOUND_MS = 1.0
BUSY_BOUND_MS = 5.0
# As installed: idle, and beside so many busy processes.
INSTALLED_BOUND_MS, HOGS = (1.0, 2.0), 12
DAEMON_CPU_BOUND = 0.02
DAEMON_MEMORY_BOUND_MB = 70.0


def bench(seed: int, seconds: float = SECONDS, *, installed: bool = False) -> dict[str, Any]:
    """Rows and checks; `ratio` is to the bound.

    Args:
        installed: Of the service instead, as it is installed, on a machine that is booted for it.
    """
    if installed:
        return of_the_service(seed, seconds)
    rows: list[Row] = []
    checks: list[Row] = []
    for work, hogs in (("idle", 0), ("all cores busy", os.cpu_count() or 1)):
        for rate_hz in RATES_HZ:
            late_ms = lateness_ms(seed, 1.0 / rate_hz, seconds, hogs)
            bound_ms = BUSY_BOUND_MS if hogs else IDLE_BOUND_MS
            _told(f"at {rate_hz} Hz, {work}", late_ms, bound_ms, rows, checks)
    cpu, memory = daemon_cost(seed, seconds)
    for process, core in cpu.items():
        rows.append(row("CPU at 10 Hz, nothing to do", process, 100.0 * core, "% of a core", core / DAEMON_CPU_BOUND))
    for process, megabytes in memory.items():
        rows.append(row("memory (PSS)", process, megabytes, "MB", megabytes / DAEMON_MEMORY_BOUND_MB))
    checks.append(check("daemon's CPU over all its processes [core]", sum(cpu.values()), DAEMON_CPU_BOUND))
    checks.append(check("daemon's memory over all its processes [MB]", sum(memory.values()), DAEMON_MEMORY_BOUND_MB))
    return {"rows": rows, "checks": checks, "seed": seed}


def _told(
    work: str, late_ms: list[float], bound_ms: float, rows: list[Row], checks: list[Row], who: str = "armctl control"
) -> None:
    for name, share in (("p50", 50), ("p99", 99), ("max", 100)):
        value_ms = float(np.percentile(late_ms, share))
        rows.append(row(f"lateness {name} {work}", who, value_ms, "ms", value_ms / bound_ms))
        if name == "p99":
            checks.append(check(f"lateness p99 {work} [ms]", value_ms, bound_ms))


def of_the_service(seed: int, seconds: float) -> dict[str, Any]:
    """How late the ticks of the installed service come, by its log, idle and beside `HOGS` processes that compute."""
    rows: list[Row] = []
    checks: list[Row] = []
    with machine("jitter") as booted:
        here = Installed(booted, seed)
        here.fetch()
        here.install()
        here.simulate()
        until(lambda: here.state() == "off", "the arm", 20.0)
        with here.in_real_time() as how:
            before = here.folder(LOGS)
            here.renew()
            spans_ns = []
            for hogs in (0, HOGS):
                with busy(hogs, seconds):
                    time.sleep(SETTLE_S)
                    begin_ns = time.monotonic_ns()
                    time.sleep(seconds)
                    spans_ns.append((begin_ns, time.monotonic_ns()))
            here.machine.must("systemctl", "stop", DAEMON)
            cycles = [cycle for _, cycle in here.messages("/armctl/cycle", but=before)]
    for (begin_ns, end_ns), load, bound_ms in zip(spans_ns, ("idle", f"load {HOGS}"), INSTALLED_BOUND_MS, strict=True):
        late_ms = [cycle.lateness_us / 1e3 for cycle in cycles if begin_ns <= cycle.now_ns < end_ns]
        _told(f"at 10 Hz, installed, {load}", late_ms, bound_ms, rows, checks, f"armctl control{how}")
    return {"rows": rows, "checks": checks, "seed": seed}


def lateness_ms(seed: int, period_s: float, seconds: float, hogs: int) -> list[float]:
    """Lateness [ms] of every tick of a control process that runs for `seconds` beside so many busy processes."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name:
        port = Path(name) / "servos"
        options = ("--link", str(port), "--seed", str(seed), "--return-delay-us", "0")
        with started(Path(name) / "simulator.log", "sim", *options):
            with socket.socket(socket.AF_UNIX) as lane:
                lane.bind("")
                lane.listen()
                settings = ControlSettings(str(port), 1_000_000, load_arm(ARM), period_s, lane.fileno())
                control = ControlProcess.start(settings)
            try:
                _records(control, SETTLE_S)
                with busy(hogs, seconds):
                    return [record.lateness_us / 1e3 for record in _records(control, seconds)]
            finally:
                control.terminate(2.0)


def _records(control: ControlProcess, seconds: float) -> list[TickRecord]:
    """What the control process sends, from its first record on for so long."""
    records: list[TickRecord] = []
    end_s = time.monotonic() + 20.0
    while (left_s := end_s - time.monotonic()) > 0.0:
        select.select([control.link], [], [], left_s)
        for message in control.link.receive():
            if isinstance(message, StartFailed):
                raise ArmctlError(f"the control process did not start: {message.error}")
            if isinstance(message, TickRecord):
                if not records:
                    end_s = time.monotonic() + seconds
                records.append(message)
    return records


@contextlib.contextmanager
def busy(hogs: int, seconds: float) -> Iterator[None]:
    """So many processes that compute; they end by themselves soon after `seconds`, whatever becomes of this one."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_burn, args=(seconds + 5.0,), daemon=True) for _ in range(hogs)]
    for process in processes:
        process.start()
    try:
        if processes:
            time.sleep(0.5)
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _burn(seconds: float) -> None:
    os.setsid()  # other work has a session of its own
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        sum(range(10_000))


def daemon_cost(seed: int, seconds: float) -> tuple[dict[str, float], dict[str, float]]:
    """CPU share of a core and memory [MB, proportional] of each of a daemon's processes, nobody watching."""
    with rig("--return-delay-us", "0", seed=seed) as running:
        pids = running.client.call("status")["pids"]
        running.stop_watching()
        time.sleep(SETTLE_S)
        before = {name: cpu_s(pid) for name, pid in pids.items()}
        begin_s = time.monotonic()
        time.sleep(seconds)
        took_s = time.monotonic() - begin_s
        cpu = {name: (cpu_s(pid) - before[name]) / took_s for name, pid in pids.items()}
        return cpu, {name: _pss_MB(pid) for name, pid in pids.items()}


def cpu_s(pid: int) -> float:
    """Processor time that all threads of a process have used so far, to the nanosecond."""
    return time.clock_gettime(~pid << 3 | 2)  # what clock_getcpuclockid(3) makes of a process on Linux


def _pss_MB(pid: int) -> float:
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024.0
    raise ArmctlError(f"/proc/{pid}/smaps_rollup tells no Pss")
