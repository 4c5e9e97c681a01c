"""Stories of the installed service: accidents, years in minutes, several arms, and the removal."""

import json
import time
from itertools import pairwise

from proving.installed import ARMCTL, DAEMON, LOGS, STILL_RAD, WEB, Installed, until, written
from proving.unit_job import added
from proving.unit_story import (
    CONFIG,
    GROWN_MB,
    OPTIMISE,
    POWER_CUTS,
    ROTATED_S,
    ROUNDS_OF_ONE,
    STARTS,
    UPGRADES,
    Told,
    story,
)

# ------------------------------------------------------------------------------------------------- accidents


@story("a typing error in the configuration stops the service once, and its words name the key")
def _(here: Installed) -> Told:
    with written(here.machine, CONFIG, here.machine.read(CONFIG) + "perid_s: 0.1\n"):
        here.machine.run("systemctl", "restart", DAEMON)
        time.sleep(6.0)
        told = here.machine.unit(DAEMON, "ActiveState", "NRestarts", "ExecMainStatus")
        named = any("perid_s" in line for line in here.journal())
    here.machine.must("systemctl", "restart", DAEMON)
    until(lambda: here.state() != "none", "the daemon", 20.0)
    return (told["ActiveState"], told["NRestarts"], told["ExecMainStatus"]) == ("failed", "0", "2") and named, told


@story("an arm of which there is no file stops the service once")
def _(here: Installed) -> Told:
    text = here.machine.read(CONFIG).replace("arm: ax12-line", "arm: nobodys")
    with written(here.machine, CONFIG, text):
        here.machine.run("systemctl", "restart", DAEMON)
        time.sleep(6.0)
        told = here.machine.unit(DAEMON, "ActiveState", "NRestarts", "ExecMainStatus")
    here.machine.must("systemctl", "restart", DAEMON)
    until(lambda: here.state() != "none", "the daemon", 20.0)
    return (told["ActiveState"], told["NRestarts"], told["ExecMainStatus"]) == ("failed", "0", "2"), told


@story("unplugged, the daemon stays and says so; replugged, it goes on as the same process")
def _(here: Installed) -> Told:
    pid, before = here.main_pid(), here.joints_rad()
    here.arm("unplug")
    until(lambda: here.call("status")["fault"] is not None, "the fault", 10.0)
    code = here.call("status")["fault"]["code"]
    here.arm("replug")
    here.acknowledge()
    return here.main_pid() == pid and here.moved_rad(before) < STILL_RAD, (code, here.moved_rad(before))


@story("a daemon that hangs is replaced by the watchdog, and the arm stays where it was")
def _(here: Installed) -> Told:
    here.holding()
    pid, before, restarts = here.main_pid(), here.joints_rad(), here.restarts()
    here.machine.must("kill", "-STOP", str(pid))
    until(lambda: here.restarts() > restarts, "the watchdog", 40.0)
    until(lambda: here.state() == "holding", "the daemon", 30.0)
    return here.main_pid() != pid and here.moved_rad(before) < STILL_RAD, f"moved {here.moved_rad(before):.4f} rad"


@story("a killed daemon comes back, and the arm stays where it was")
def _(here: Installed) -> Told:
    here.holding()
    pid, before = here.main_pid(), here.joints_rad()
    here.machine.must("kill", "-KILL", str(pid))
    until(lambda: here.main_pid() not in (0, pid) and here.state() == "holding", "the daemon", 30.0)
    return here.moved_rad(before) < STILL_RAD, f"moved {here.moved_rad(before):.4f} rad"


@story("a killed control process is replaced by its daemon, and the arm stays where it was")
def _(here: Installed) -> Told:
    here.holding()
    pid, before = here.main_pid(), here.joints_rad()
    [control] = here.controls(pid)
    here.machine.must("kill", "-KILL", str(control))
    until(lambda: here.controls(pid) not in ([], [control]) and here.state() == "holding", "another", 20.0)
    return here.main_pid() == pid and here.moved_rad(before) < STILL_RAD, f"moved {here.moved_rad(before):.4f} rad"


@story("a closed terminal (SIGHUP) ends the daemon as SIGTERM does")
def _(here: Installed) -> Told:
    here.machine.must("systemctl", "stop", DAEMON)
    config = "--config=/etc/armctl/armctl.yaml"
    daemon = here.machine.start(ARMCTL, "daemon", config, "--socket=/tmp/hup.sock", "--log-dir=/tmp/hup")
    until(lambda: here.machine.run("test", "-S", "/tmp/hup.sock").returncode == 0, "the daemon")
    assert daemon.stdout is not None
    daemon.stdout.readline()  # ready
    [pid] = here.machine.must("pgrep", "-f", "socket=/tmp/hup.sock").split()[:1]
    here.machine.must("kill", "-HUP", pid)
    daemon.communicate(timeout=20)
    left = here.machine.run("test", "-e", "/tmp/hup.sock").returncode == 0
    logs = here.folder("/tmp/hup")
    here.machine.must("systemctl", "start", DAEMON)
    until(lambda: here.state() != "none", "the daemon", 20.0)
    return daemon.returncode == 0 and not left and not any(".part" in log for log in logs), (
        daemon.returncode,
        left,
        logs,
    )


@story("an optimisation that cannot fit is refused, and the daemon goes on")
def _(here: Installed) -> Told:
    pid = here.main_pid()
    body = {**OPTIMISE, "recordings": ["line-1"], "name": "huge", "settings": {"population": 100_000}}
    status, answer = here.ask("/optimize", body, wait_s=60.0)
    return status in (409, 422) and here.main_pid() == pid and here.state() != "none", (status, answer)


@story("a job that is killed, as for want of memory, ends alone")
def _(here: Installed) -> Told:
    pid = here.main_pid()
    body = {**OPTIMISE, "recordings": ["line-1"], "name": "killed", "settings": {"generations": 5000}}
    here.machine.write("/tmp/ask.json", json.dumps(body))
    asking = here.machine.start(
        "curl", "-s", "-H", f"X-Armctl-Token: {here.token}", "-H", "Content-Type: application/json",
        "-d", "@/tmp/ask.json", f"{WEB}/api/optimize",
    )  # fmt: skip
    until(lambda: len(_jobs(here, pid)) >= 1, "the job", 20.0)
    time.sleep(1.0)
    for job in _jobs(here, pid):
        here.machine.must("kill", "-KILL", str(job))
    said, _ = asking.communicate(timeout=60)
    told = here.machine.unit(DAEMON, "OOMPolicy", "ActiveState")
    return "JOB_FAILED" in said and here.main_pid() == pid and told["OOMPolicy"] == "continue", (said[:120], told)


def _jobs(here: Installed, daemon: int) -> list[int]:
    """The job under way: a spawned child that is no control process and no keeper of semaphores."""
    return [
        child
        for child in here.children(daemon)
        if "spawn_main" in here.machine.read(f"/proc/{child}/cmdline").replace("\0", " ")
    ]


@story("a full disk ends the log, not the control")
def _(here: Installed) -> Told:
    here.holding()
    here.machine.must("systemctl", "stop", DAEMON)
    here.machine.must(
        "mount", "-t", "tmpfs", "-o", "size=1m,mode=750,uid=armctl,gid=armctl", "tmpfs", "/var/lib/armctl"
    )
    try:
        here.machine.must("systemctl", "start", DAEMON)
        until(lambda: here.state() == "holding", "the daemon", 20.0)
        here.machine.run("sh", "-c", "head -c 2000000 /dev/zero >/var/lib/armctl/fill")
        time.sleep(4.0)
        before = here.call("status")["tick"]
        time.sleep(1.0)
        ticks = here.call("status")["tick"] - before
    finally:
        here.machine.run("systemctl", "stop", DAEMON)
        here.machine.must("umount", "/var/lib/armctl")
        here.machine.must("systemctl", "start", DAEMON)
    until(lambda: here.state() == "holding", "the daemon", 20.0)
    return 7 <= ticks <= 13, f"{ticks} ticks in a second"


@story("twenty looks leave no line in the journal")
def _(here: Installed) -> Told:
    time.sleep(1.0)
    before = len(here.journal())
    for _ in range(20):
        here.call("status")
    time.sleep(0.5)
    more = here.journal()[before:]
    return not more, more[:3] or "none"


@story("a report by who uses the service holds its logs, and neither host name nor a user's paths")
def _(here: Installed) -> Told:
    here.machine.must("hostname", "my-own-host")
    done = here.machine.run(ARMCTL, "report", "--out", "/tmp/eve.zip", user="eve", wait_s=180.0)
    names = here.machine.run("python3", "-m", "zipfile", "--list", "/tmp/eve.zip").stdout
    here.machine.run("python3", "-m", "zipfile", "--extract", "/tmp/eve.zip", "/tmp/eve")
    clear = here.machine.run(
        "grep", "-rlE", "my-own-host|/home/eve", "/tmp/eve", "--include=*.json", "--include=*.txt", "--include=*.yaml"
    )
    return done.returncode == 0 and "logs/" in names and not clear.stdout, (
        done.returncode,
        "logs/" in names,
        clear.stdout,
    )


# -------------------------------------------------------------------------------------------- over time


@story(f"{STARTS} starts and stops: each clean, the arm never moved")
def _(here: Installed) -> Told:
    here.holding()
    before, unclean = here.joints_rad(), 0
    for _ in range(STARTS):
        here.machine.must("systemctl", "restart", DAEMON)
        unclean += here.machine.unit(DAEMON, "Result")["Result"] != "success"
        until(lambda: here.state() == "holding", "the daemon", 20.0)
    return unclean == 0 and here.moved_rad(
        before
    ) < STILL_RAD, f"{unclean} unclean, moved {here.moved_rad(before):.4f} rad"


@story(f"{UPGRADES} upgrades lose nothing")
def _(here: Installed) -> Told:
    here.holding()
    kept = here.folder("/var/lib/armctl/recordings"), here.machine.read(CONFIG), here.joints_rad()
    for _ in range(UPGRADES):
        here.machine.must("touch", "/opt/armctl/bin/armctl")
        here.upgrade()
        if (done := here.install())[0] != 0:
            return False, done
        until(lambda: here.state() == "holding", "the daemon", 20.0)
    same = here.folder("/var/lib/armctl/recordings"), here.machine.read(CONFIG)
    return same == kept[:2] and here.moved_rad(kept[2]) < STILL_RAD, f"moved {here.moved_rad(kept[2]):.4f} rad"


@story(f"as installed: of {ROUNDS_OF_ONE:,} rounds of readings one is missing at most, and nothing grows")
def _(here: Installed) -> Told:
    with here.in_real_time() as how:
        here.holding()
        here.machine.must("systemctl", "stop", DAEMON)
        before = set(here.folder(LOGS))
        here.machine.must("systemctl", "start", DAEMON)
        until(lambda: here.state() == "holding", "the daemon", 20.0)
        # Its history of two minutes is full by then, and in a long watch its first log is rotated and compacted.
        settled_s = max(0.5 * here.lasts_s, min(ROTATED_S, 0.6 * here.lasts_s))
        time.sleep(settled_s)
        memory_MB, files = _size(here)
        time.sleep(here.lasts_s - settled_s)
        grown_MB, more = (now - then for now, then in zip(_size(here), (memory_MB, files), strict=True))
        here.machine.must("systemctl", "stop", DAEMON)
    messages = here.messages("/armctl/servos", but=before)
    rounds = [(at_ns, all(servo.fresh for servo in one.servos)) for at_ns, one in messages]
    whole_ns = [at_ns for at_ns, whole in rounds if whole]
    here.machine.must("systemctl", "start", DAEMON)
    until(lambda: here.state() == "holding", "the daemon", 20.0)
    due = round((rounds[-1][0] - whole_ns[0]) / 1e8) + 1  # only before its first one was it not reading yet
    missing = due - len(whole_ns)
    early = sum(b - a < 5e7 for a, b in pairwise(whole_ns))
    held = -1 <= missing <= due // ROUNDS_OF_ONE and grown_MB <= GROWN_MB and more <= 0 and due >= 10.0 * here.lasts_s
    size = f"{memory_MB:.1f} MB and {grown_MB:+.2f}, {files:.0f} files and {more:+.0f}"
    return held, f"{missing} of {due} missing, {early} came early, {size}{how}"


def _size(here: Installed) -> tuple[float, float]:
    """Memory [MB] of the daemon's processes that is theirs alone, and how many files they have open."""
    pid = here.main_pid()
    processes = [f"/proc/{one}" for one in (pid, *here.children(pid))]
    lines = [line.split() for one in processes for line in here.machine.read(f"{one}/smaps_rollup").splitlines()]
    own_kB = sum(int(line[1]) for line in lines if line[0] == "Anonymous:")
    return own_kB / 1024.0, float(sum(len(here.folder(f"{one}/fd")) for one in processes))


@story(f"{POWER_CUTS} power cuts: the service comes back by itself, no recording and no setting is lost")
def _(here: Installed) -> Told:
    kept = here.folder("/var/lib/armctl/recordings"), here.folder("/var/lib/armctl/plans"), here.machine.read(CONFIG)
    for _ in range(POWER_CUTS):
        here.machine.power_cut()
        here.machine.boot()
        here.simulate()
        until(lambda: here.state() == "off", "the daemon", 30.0)
    after = here.folder("/var/lib/armctl/recordings"), here.folder("/var/lib/armctl/plans"), here.machine.read(CONFIG)
    mended_s = until(
        lambda: sum(name.endswith(".part") for name in here.folder(LOGS)) <= 1, "the end of each log", 10.0
    )
    return kept == after, f"every log but the one under way has an end {mended_s:.0f} s after the last"


@story("after a reboot daemon and dashboard are there, with the same tokens and plans")
def _(here: Installed) -> Told:
    here.machine.reboot()
    here.simulate()
    until(lambda: here.state() == "off", "the daemon", 30.0)
    until(lambda: here.machine.ask(f"{WEB}/")[0] == 200, "the page", 30.0)
    ada = added(here, "ada2", "look")
    here.token = here.local_token()
    names = [plan["name"] for plan in here.ask("/plans")[1]["plans"]]
    people = [one["name"] for one in here.machine.json(ARMCTL, "web", "token", "list")["tokens"]]
    return names == ["proved-via2"] and "ada" in people and here.ask("/status", token=ada)[0] == 200, (names, people)


# ------------------------------------------------------------------------------------------- several arms


@story("a second arm has a service, a socket and a port of its own")
def _(here: Installed) -> Told:
    here.machine.must("install", "-d", "-o", "armctl", "-g", "armctl", "/dev/left")
    here.simulate("/dev/left/servos", "proving-left")
    here.machine.write("/etc/armctl/left.yaml", "port: /dev/left/servos\narm: ax12-line\n")
    here.machine.must("systemctl", "enable", "--now", "armctl@left")
    until(lambda: here.state("/run/armctl/left.sock") == "off", "the second daemon", 20.0)
    both = here.machine.json(ARMCTL, "status", "--all")
    here.call("torque_on", "/run/armctl/left.sock")
    return len(both["arms"]) == 2 and here.state() == "off", [one["arm"] for one in both["arms"]]


@story("armctl --arm NAME speaks to that arm alone")
def _(here: Installed) -> Told:
    left = here.machine.json(ARMCTL, "status", "--arm", "left")["state"]
    here.machine.must("systemctl", "disable", "--now", "armctl@left")
    return left == "holding" and here.state() == "off", (left, here.state())


@story("in the network the page is served over TLS, to people with tokens, by its own names")
def _(here: Installed) -> Told:
    here.machine.must("systemctl", "start", "armctl-web-lan")
    address = "https://127.0.0.1:8443/api/status"
    token = added(here, "katherine", "look")
    until(lambda: here.machine.ask(address, token=token)[0] == 200, "the page", 30.0)
    without = here.machine.ask(address)[0]
    plain = here.machine.ask(address.replace("https", "http"), token=token)[0]
    other = here.machine.run(
        "curl", "-sk", "-o", "/dev/null", "-w", "%{http_code}", "-H", "Host: evil.example", address
    )
    key = here.machine.run("stat", "-c", "%a", "/var/lib/armctl-web-lan/key.pem").stdout.strip()
    listening = here.machine.run("systemctl", "is-enabled", "armctl-web-lan").stdout.strip()
    here.machine.must("systemctl", "stop", "armctl-web-lan")
    seen = (without, plain, other.stdout, key, listening)
    return seen == (401, 0, "421", "600", "disabled"), seen


# ------------------------------------------------------------------------------------------------- the end


@story("uninstall removes the units and keeps data and settings; twice is as good as once", short=True)
def _(here: Installed) -> Told:
    first = here.machine.run(ARMCTL, "uninstall").returncode
    second = here.machine.run(ARMCTL, "uninstall").returncode
    left = [
        name for name in here.folder("/etc/systemd/system") if name.startswith("armctl") and not name.endswith(".d")
    ]
    kept = "armctl.yaml" in here.folder("/etc/armctl")
    return (first, second, left) == (0, 0, []) and kept, (first, second, left)


@story("installed again, it serves with what was kept", short=True)
def _(here: Installed) -> Told:
    status, words = here.install()
    until(lambda: here.state() != "none", "the daemon", 30.0)
    return status == 0, words.strip()[-100:]
