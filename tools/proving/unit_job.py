"""Stories of the installed service: a newcomer, the job over the page, people, and an installation again."""

import time

from proving.installed import ARMCTL, DAEMON, DASHBOARD, FROM_M, STILL_RAD, TO_M, WEB, Installed, until
from proving.unit_story import (
    CONFIG,
    MISSING_S,
    MISSING_SHARE,
    OPTIMISE,
    Told,
    story,
)

# ------------------------------------------------------------------------------------------------ a newcomer


@story("armctl is installed from its wheel into /opt/armctl, without an adapter and without a warning", short=True)
def _(here: Installed) -> Told:
    here.machine.must("useradd", "--no-create-home", "eve")
    here.machine.must("useradd", "--no-create-home", "mallory")
    here.fetch()
    before = here.folder("/etc/systemd/system")
    status, words = here.install("--dry-run")
    untouched = here.folder("/etc/systemd/system") == before and status == 0
    here.step(ARMCTL, "install", "--user", "eve")
    return untouched and "would" in words, f"dry run changed nothing: {untouched}"


@story("systemd-analyze has nothing to say of the installed units", short=True)
def _(here: Installed) -> Told:
    units = [f"/etc/systemd/system/{unit}" for unit in here.folder("/etc/systemd/system") if unit.startswith("armctl")]
    services = [unit for unit in units if unit.endswith(".service")]
    done = here.machine.run("systemd-analyze", "verify", *services)
    return len(
        services
    ) >= 2 and done.returncode == 0 and not done.stderr, done.stderr.strip() or f"{len(services)} units"


@story("without an adapter the daemon is there, waits, and says for what", short=True)
def _(here: Installed) -> Told:
    told = here.machine.unit(DAEMON, "ActiveState", "StatusText", "NRestarts")
    return told["ActiveState"] == "active" and "/dev/armctl" in told["StatusText"], told


@story("a missing adapter costs less than 0.1 % of a core")
def _(here: Installed) -> Told:
    time.sleep(5.0)  # it has started by then
    before_s = here.machine.cpu_s()
    time.sleep(MISSING_S)
    share = (here.machine.cpu_s() - before_s) / MISSING_S
    return here.restarts() == 0 and share < MISSING_SHARE, f"{share:.5f} of a core, {here.restarts()} restarts"


@story("plugged in, the adapter is served within 10 s, by nobody's command", short=True)
def _(here: Installed) -> Told:
    here.simulate()
    took_s = until(lambda: here.state() == "off", "the arm", 20.0)
    return took_s < 10.0, f"{took_s:.1f} s"


@story("who belongs to the group looks and commands; who does not, reaches nothing", short=True)
def _(here: Installed) -> Told:
    inside = here.machine.run(ARMCTL, "status", "--json", user="eve").returncode
    outside = here.machine.run(ARMCTL, "status", "--json", user="mallory").returncode
    return inside == 0 and outside == 3, f"eve {inside}, mallory {outside}"


@story("the control process has real-time priority, the daemon's session goes first, both without a capability")
def _(here: Installed) -> Told:
    told = here.machine.unit(DAEMON, "LimitRTPRIO", "CapabilityBoundingSet", "AmbientCapabilities")
    given = (told["LimitRTPRIO"], told["CapabilityBoundingSet"], told["AmbientCapabilities"]) == ("10", "", "")
    with here.in_real_time() as how:
        policy, session = here.policy(), here.precedence()
    first = policy == "1" and session == "-10"
    return given and first, f"policy {policy} (1: SCHED_FIFO), session {session}{how}; {told}"


@story("the dashboard starts when it is enabled", short=True)
def _(here: Installed) -> Told:
    here.step("systemctl", "enable", "--now", DASHBOARD)
    until(lambda: here.machine.ask(f"{WEB}/")[0] == 200, "the page")
    return True, f"{len(here.steps)} commands of a newcomer, {sum(took_s for _, took_s in here.steps):.0f} s"


@story("the local token is read by the group, by nobody else", short=True)
def _(here: Installed) -> Told:
    here.token = here.local_token()
    inside = here.machine.run("cat", "/run/armctl-web/address", user="eve")
    outside = here.machine.run("cat", "/run/armctl-web/address", user="mallory")
    asked, _ = here.ask("/status")
    ok = len(here.token) >= 20 and inside.returncode == 0 and outside.returncode != 0 and asked == 200
    return ok, f"eve {inside.returncode}, mallory {outside.returncode}, HTTP {asked}"


@story("no token stands in the journal", short=True)
def _(here: Installed) -> Told:
    lines = here.journal(DASHBOARD)
    return bool(here.token) and not any(here.token in line or "token=" in line for line in lines), f"{len(lines)} lines"


@story("the page says where its token is found", short=True)
def _(here: Installed) -> Told:
    status, answer = here.ask("/status", token="wrong")
    return status == 401 and "/run/armctl-web/address" in answer["error"]["message"], answer


@story("the local token is the same after a restart of the dashboard")
def _(here: Installed) -> Told:
    before = here.token
    here.machine.must("systemctl", "restart", DASHBOARD)
    until(lambda: here.ask("/status")[0] == 200, "the old token's welcome", 15.0)
    return here.local_token() == before, "same" if here.local_token() == before else "another"


# ------------------------------------------------------------------------------------- the job, over the page


@story("teaching over HTTP records the hand")
def _(here: Installed) -> Told:
    here.acknowledge()
    for path, body in (("/teach/begin", {"confirm": True}), ("/take/begin", {"name": "line-1"})):
        status, answer = here.ask(path, body)
        if status != 200:
            return False, (path, answer)
    seconds = here.arm("guide", params={"from": FROM_M, "to": TO_M, "seed": 1})["duration_s"]
    time.sleep(seconds + 1.0)
    ended = [here.ask(path, {})[0] for path in ("/take/end", "/teach/end")]
    names = [one["name"] for one in here.ask("/recordings")[1]["recordings"]]
    return ended == [200, 200] and names == ["line-1"], (ended, names)


@story("a recording is shown over HTTP")
def _(here: Installed) -> Told:
    status, answer = here.ask("/recordings/line-1")
    return status == 200 and len(answer["tool_m"]) > 10, f"HTTP {status}, {len(answer['tool_m'])} points"


@story("optimising over HTTP keeps its plan")
def _(here: Installed) -> Told:
    status, answer = here.ask("/optimize", {**OPTIMISE, "recordings": ["line-1"]}, wait_s=120.0)
    names = [plan["name"] for plan in here.ask("/plans")[1]["plans"]]
    return status == 200 and names == ["proved-via2"], (status, names, answer.get("error"))


@story("a name of a plan that is taken is refused before anything is computed")
def _(here: Installed) -> Told:
    begin_s = time.monotonic()
    status, answer = here.ask("/optimize", {**OPTIMISE, "recordings": ["line-1"]}, wait_s=120.0)
    took_s = time.monotonic() - begin_s
    return status == 409 and answer["error"]["code"] == "EXISTS" and took_s < 2.0, f"HTTP {status} after {took_s:.1f} s"


@story("a plan is run over HTTP, and its run is recorded")
def _(here: Installed) -> Told:
    here.holding()
    here.arm("let_go")
    status, answer = here.ask("/plans/proved-via2/run", {}, wait_s=120.0)
    return status == 200 and "recording" in answer, (status, answer.get("error") or answer.get("mean_error_mm"))


@story("STOP over HTTP stops a run")
def _(here: Installed) -> Told:
    here.holding()
    address = f"{WEB}/api/plans/proved-via2/run"
    headers = f"X-Armctl-Token: {here.token}"
    asking = here.machine.start(
        "curl", "-s", "-X", "POST", "-H", headers, "-H", "Content-Type: application/json", "-d", "{}", address
    )
    until(lambda: here.state() == "moving", "the motion", 15.0)
    stopped, answer = here.ask("/stop", {})
    said, _ = asking.communicate(timeout=30)
    return stopped == 200 and here.state() == "holding" and "error" in said, (answer, said[:120])


# ------------------------------------------------------------------------------------------------- who it is


def added(here: Installed, name: str, role: str) -> str:
    words = here.machine.must(ARMCTL, "web", "token", "add", name, "--role", role)
    return max(words.replace("=", " ").split(), key=len)


@story("a person's token opens the page; at rest it is hashed")
def _(here: Installed) -> Told:
    token = added(here, "ada", "command")
    status, _ = here.ask("/status", token=token)
    kept = here.machine.run("grep", "-rlF", token, "/etc/armctl", "/var/lib/armctl", "/run/armctl-web").stdout.strip()
    return status == 200 and not kept, f"HTTP {status}, in the clear in: {kept or 'no file'}"


@story("the audit names the person")
def _(here: Installed) -> Told:
    token = added(here, "grace", "command")
    status, _ = here.ask("/torque-on", {}, token=token)
    time.sleep(1.5)  # a log is flushed each second
    found = here.logged("grace")
    return found > 0, f"HTTP {status}, messages that name her: {found}"


@story("who may only look is refused commands, and may stop the arm")
def _(here: Installed) -> Told:
    token = added(here, "linus", "look")
    statuses = [
        here.ask(path, body, token=token)[0] for path, body in (("/status", None), ("/park", {}), ("/stop", {}))
    ]
    return statuses == [200, 403, 200], statuses


@story("a revoked token is refused at once")
def _(here: Installed) -> Told:
    token = added(here, "eve2", "command")
    before = here.ask("/status", token=token)[0]
    here.machine.must(ARMCTL, "web", "token", "revoke", "eve2")
    after = here.ask("/status", token=token)[0]
    names = [one["name"] for one in here.machine.json(ARMCTL, "web", "token", "list")["tokens"]]
    return (before, after) == (200, 401) and "eve2" not in names and "ada" in names, (before, after, names)


# ------------------------------------------------------------------------------------------------- install again


@story("installing once more changes nothing and restarts nothing")
def _(here: Installed) -> Told:
    before = here.main_pid()
    status, words = here.install()
    unplugged, _ = here.install("--port", "/dev/not-plugged-in")
    return (status, unplugged) == (0, 0) and here.main_pid() == before, words.strip().splitlines()[-1:]


@story("an upgrade while the arm moves is refused, and the motion goes on")
def _(here: Installed) -> Told:
    here.holding()
    before = here.main_pid()
    here.upgrade()
    runs = here.machine.start(ARMCTL, "move", "--xyz", "0.18,0.1,0.12", "--duration", "8")
    until(lambda: here.state() == "moving", "the motion", 15.0)
    status, words = here.install()
    state = here.state()
    runs.communicate(timeout=60)
    ok = status == 1 and state == "moving" and here.main_pid() == before and runs.returncode == 0
    return ok, (status, state, runs.returncode, words.strip()[-160:])


@story("an upgrade at rest restarts the daemon once; data, settings and the arm stay as they were")
def _(here: Installed) -> Told:
    until(lambda: here.state() == "holding", "rest", 15.0)
    before, pid = here.joints_rad(), here.main_pid()
    files = here.folder("/var/lib/armctl/recordings"), here.folder("/var/lib/armctl/plans"), here.machine.read(CONFIG)
    status, words = here.install()
    until(lambda: here.state() == "holding", "the daemon", 20.0)
    after = here.folder("/var/lib/armctl/recordings"), here.folder("/var/lib/armctl/plans"), here.machine.read(CONFIG)
    ok = status == 0 and here.main_pid() != pid and here.moved_rad(before) < STILL_RAD and files == after
    return ok, (status, here.moved_rad(before), words.strip()[-100:])


@story("a drop-in of the user survives an installation, and an edited unit is shown before it is replaced")
def _(here: Installed) -> Told:
    drop_in, unit = f"/etc/systemd/system/{DAEMON}.d/mine.conf", f"/etc/systemd/system/{DAEMON}"
    here.machine.write(drop_in, "[Service]\nEnvironment=MINE=1\n")
    here.machine.must("sh", "-c", f"echo '# my own line' >>{unit}")
    status, words = here.install()
    until(lambda: here.state() == "holding", "the daemon", 20.0)
    mine = here.machine.unit(DAEMON, "Environment")["Environment"]
    ok = status == 0 and "MINE=1" in mine and "-# my own line" in words and "my own line" not in here.machine.read(unit)
    return ok, words.strip()[-160:]


@story("a prefix that is relative, or has a blank or a percent sign, is refused")
def _(here: Installed) -> Told:
    here.machine.must(
        "sh",
        "-c",
        "mkdir -p '/opt/a b' '/opt/50%' && cp -rs /opt/armctl/bin '/opt/a b/' && cp -rs /opt/armctl/bin '/opt/50%/'",
    )
    relative = here.machine.run("sh", "-c", f"cd /opt && {ARMCTL} install --dry-run --prefix armctl").returncode
    statuses = [relative, *(here.install("--dry-run", "--prefix", prefix)[0] for prefix in ("/opt/a b", "/opt/50%"))]
    return statuses == [2, 2, 2], statuses


@story("an arm's file that is not valid is refused, and nothing is installed of it")
def _(here: Installed) -> Told:
    here.machine.write("/tmp/broken.yaml", "arm_id: broken\nrobot: no-such-robot\n")
    status, words = here.install("--arm", "/tmp/broken.yaml")
    return status == 2 and "broken.yaml" not in here.folder("/etc/armctl/calibration"), (status, words.strip()[:160])


@story("install --arm changes the arm that is served, and back")
def _(here: Installed) -> Told:
    calibration = here.machine.must(
        "sh", "-c", "cat /opt/armctl/lib/python3*/site-packages/armctl/calibration/ax12-line.yaml"
    )
    here.machine.write("/tmp/other-arm.yaml", calibration.replace("arm_id: ax12-line", "arm_id: other-arm"))
    status, words = here.install("--arm", "/tmp/other-arm.yaml")
    until(lambda: here.state() != "none", "the daemon", 20.0)
    served = here.call("status")["arm_id"]
    back, _ = here.install("--arm", "ax12-line")
    until(lambda: here.state() != "none", "the daemon", 20.0)
    return (status, served, back) == (0, "other-arm", 0) and here.call("status")["arm_id"] == "ax12-line", (
        served,
        words[-160:],
    )
