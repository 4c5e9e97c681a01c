// The dashboard. Everything that comes from the daemon goes into text nodes and never into markup, so it cannot run as code.

import { repaint as repaintCharts } from "/charts.js";
import { loadCompare } from "/compare.js";
import { Drive } from "/drive.js";
import { distance, wantedLine } from "/geometry.js";
import { enterGuide, guide, pointLed, progressed, showTeaching, wireGuide } from "/guide.js";
import { drawLive, remember } from "/live.js";
import { loadLogs, wireLogs } from "/logs.js";
import { enterProgram, stepped, wireProgram } from "/program.js";
import { enterSetUp, settingUp, showSetUp, wireSetUp } from "/setup.js";
import { $, act, after, armView, asked, confirmed, degrees, logIn, millimetres, page, post, request, tell, token, torqueOn, views, words } from "/page.js";

let drive = null;
const trail = [];
const TRAIL = 150;
// The tool has gone on when it is so far from where the trail ends [m]; a picture of an arm that stands stays as it is.
// Readings go to and fro by a tick, 0.0051 rad.
const [FARTHER_M, STILL_RAD] = [0.001, 0.006];

async function stop() {
  const button = $("stop");
  button.dataset.sent = "";
  try {
    await post("/stop");
  } catch (error) {
    tell(`STOP FAILED (${error.message}). If the arm must stop, support it first, then use the power switch.`);
  } finally {
    setTimeout(() => delete button.dataset.sent, 600);
  }
}

// ------------------------------------------------------------------------------------------------- live view

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/stream`);
  socket.onopen = () => socket.send(JSON.stringify({ token }));
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.kind === "snapshot") show(message.snapshot);
    else if (message.kind === "progress") (message.step ? stepped : progressed)(message);
    else if (message.kind === "setup") {
      showSetUp(message);
      show(page.snapshot);
    }
  };
  socket.onclose = (event) => {
    show(null);
    if (event.code === 1008) logIn();
    else setTimeout(connect, 1000);
  };
}

// Which arm this page shows, by its calibration: none yet, or, empty, none that the server knows.
let shown = null;

// Begin anew where the daemon drives another arm than before.
function follow({ calibration_hash }) {
  if (shown === "") shown = calibration_hash;
  else if (shown !== null && shown !== calibration_hash) location.reload();
}

function show(latest) {
  page.snapshot = latest;
  if (latest) follow(latest);
  const state = latest ? latest.state : settingUp() ? "setting up" : "unreachable";
  if ($("state").textContent !== state) $("state").textContent = state;
  $("state").dataset.state = state;
  showFaults(latest ? latest.faults : []);
  const notice = latest && latest.notice && !latest.fault ? latest.notice : "";
  if ($("notice-text").textContent !== notice) $("notice-text").textContent = notice;
  $("notice").hidden = !notice;
  controls();
  keepRate(state);
  if (drive) drive.show(state, latest?.joints ?? []);
  if (!latest) return;
  latest.joints.forEach(showJoint);
  const place = latest.tool && latest.tool.position_m;
  $("tool").textContent = place ? place.map((value) => Math.round(1000 * value) || 0).join(", ") + " mm" : "–";
  $("tick").textContent = latest.tick;
  $("bus").textContent = `${(latest.cycle.bus_us_p50 / 1000).toFixed(1)} ms`;
  $("log").textContent = latest.log && latest.log.problem ? latest.log.problem : "recording";
  $("log").className = latest.log && latest.log.problem ? "alarm" : "";
  $("commander-part").hidden = !latest.commander;
  $("commander").textContent = latest.commander ?? "";
  $("run-progress").value = latest.progress ?? 0;
  if (place) {
    if (!trail.length || Math.hypot(...place.map((value, i) => value - trail.at(-1)[i])) > FARTHER_M) trail.push(place);
    if (trail.length > TRAIL) trail.shift();
    const line = wantedLine();
    $("line-error-part").hidden = !line;
    if (line) $("line-error").textContent = millimetres(distance(place, ...line));
    if (guide.taking && line) showTeaching(place, latest.tool.speed_m_s, line);
  }
  drawArm(true);
  remember(latest);
  if (!$("view-live").hidden && !document.hidden) drawLive();
}

// How fast motions run, of their planned speed: said to the one under way, and to each that begins.
const rate = { wanted: 1, said: 1 };

function keepRate(state) {
  if (state !== "moving") rate.said = 1;
  if (state !== "moving" || rate.said === rate.wanted || !(page.snapshot.rate > 0)) return;  // a paused one would go on
  rate.said = rate.wanted;
  act(null, () => post("/rate", { rate: rate.wanted }));
}

function setRate(share) {
  rate.wanted = share;
  for (const slider of document.querySelectorAll(".rate")) slider.value = String(100 * share);
  for (const told of document.querySelectorAll(".rate-told")) told.textContent = `${Math.round(100 * share)} %`;
}

// What a card says to type, and which button here does the same.
const BUTTONS = { clear: "Clear the fault", release: "Release", "torque on": "Torque on", park: "Park", stop: "STOP" };
const pressed = (text) => text.replace(/(?:type )?`armctl (clear|release|torque on|park|stop)`/g, (_, name) => `press \u201c${BUTTONS[name]}\u201d`);
let cards = "";

// A card for every fault, the worst first; one that follows from another is over with that.
function showFaults(faults) {
  if (faults.length && $("fault").hidden) scrollTo(0, 0);  // where its card stands
  $("fault").hidden = !faults.length;
  const told = faults.map(({ code, servo_id, text, arm: doing, next, follows }) => [
    `${code}${servo_id === null ? "" : `, servo ${servo_id}`}`, text ?? "", ...(follows ? [`It follows from ${follows}.`] : [`The arm: ${doing}`, `Next: ${pressed(next)}`]),
  ]);
  if (cards === (cards = JSON.stringify(told))) return;  // said aloud once
  $("faults").replaceChildren(...told.map(([title, ...lines]) => {
    const card = document.createElement("article"), heading = document.createElement("h2");
    heading.textContent = title;
    card.append(heading, ...lines.filter(Boolean).map((line) => {
      const said = document.createElement("p");
      said.append(...words(line));
      return said;
    }));
    return card;
  }));
}

function showJoint(joint, index) {
  const row = $("joints").tBodies[0].rows[index];
  if (!row || !page.arm) return;
  const known = joint.position_rad !== null;
  const cells = row.cells;
  put(cells[1], known ? `${degrees(joint.position_rad).toFixed(1)}°` : "–", false);
  put(cells[3], known ? `${(100 * Math.abs(joint.load_ratio)).toFixed(0)} %` : "–", Math.abs(joint.load_ratio) > 0.8);
  put(cells[4], known ? `${joint.temperature_degC.toFixed(0)} °C` : "–", joint.temperature_degC >= page.arm.temperature_limit_degC);
  put(cells[5], known ? `${joint.voltage_V.toFixed(1)} V` : "–", known && (joint.voltage_V < page.arm.voltage_V[0] || joint.voltage_V > page.arm.voltage_V[1]));
  const stale = joint.age_s > 0.5;
  put(cells[6], stale ? "silent" : joint.torque_enabled ? "on" : "off", stale);
}

function put(cell, text, alarm) {
  if (cell.textContent !== text) cell.textContent = text;
  cell.className = alarm ? "alarm" : "";
}

function makeJointRows() {
  const body = $("joints").tBodies[0];
  for (const joint of page.arm.joints) {
    const row = body.insertRow();
    const name = document.createElement("th");
    name.scope = "row";
    name.textContent = joint.name;
    row.append(name);
    row.insertCell().textContent = "–";
    row.insertCell().append(drive.slider(joint));
    for (let i = 0; i < 4; i++) row.insertCell().textContent = "–";
  }
}

function controls() {
  const state = page.snapshot ? page.snapshot.state : "unreachable";
  const command = (name) => document.querySelector(`[data-command="${name}"]`);
  $("look-only").hidden = !page.looksOnly;
  for (const part of document.querySelectorAll(".commands")) part.disabled = page.looksOnly;
  command("torque-on").disabled = state !== "off";
  command("park").disabled = state !== "holding";
  command("pause").disabled = state !== "moving" || !(page.snapshot.rate > 0);
  command("resume").disabled = state !== "moving" || page.snapshot.rate > 0;
  $("release").disabled = state === "unreachable";
  const teaching = state === "teaching";
  // A gap in what is heard of the arm does not end a take.
  if (!teaching && state !== "stalled" && state !== "unreachable") guide.taking = null;
  $("teach-begin").disabled = !(state === "off" || state === "holding");
  $("take").disabled = !teaching;
  $("take-by-hand").disabled = !teaching || guide.taking !== null;
  $("take").textContent = guide.taking ? "End the take" : "Begin a take";
  $("teach-end").disabled = !teaching || guide.taking !== null;
  // Between two runs of a refinement the arm holds.
  $("program-run").disabled = !(state === "holding" || state === "off");
  for (const id of ["run", "refine"]) $(id).disabled = guide.running || !$("plan-choice").value || !(state === "holding" || state === "off");
}

// ------------------------------------------------------------------------------------------------- pictures

const calm = matchMedia("(prefers-reduced-motion: reduce)");

// What is drawn already takes the page's new colours.
function repaint() {
  repaintCharts();
  for (const made of views) made.paint();
}

let lineDrawn = "";

// `glide`: on the way there from what is shown, if there is any.
function drawArm(glide = false) {
  if (!page.view || $("scene").closest("section").hidden || document.hidden || !page.snapshot) return;
  const q = page.snapshot.joints.map((joint) => joint.position_rad);
  if (q.includes(null)) return;
  const line = wantedLine() || [], still = page.view.wanted?.every((angle, i) => Math.abs(angle - q[i]) < STILL_RAD);
  if (glide && still && String(line) === lineDrawn) return;
  lineDrawn = String(line);
  page.view.pose(q, glide && !calm.matches);
  page.view.curve("line", line, "--red", true);
  page.view.curve("trail", trail, "--soft");
}

// ------------------------------------------------------------------------------------------------- wiring

// The arm is drawn where it is looked at.
function showArmIn(slot) {
  $(slot).prepend($("scene"));
  if (page.view) {
    page.view.keep(["line", "trail"]);
    page.view.balls([], "--blue");
  }
  drawArm();
}

const ENTER = {
  arm: () => showArmIn("arm-slot"), live: drawLive,
  guide: () => {
    showArmIn("guide-slot");
    return enterGuide();
  },
  program: () => {
    showArmIn("program-slot");
    return enterProgram();
  },
  compare: loadCompare, logs: loadLogs, setup: enterSetUp,
};

function view(name) {
  for (const section of document.querySelectorAll("main > section")) section.hidden = section.id !== `view-${name}`;
  for (const button of document.querySelectorAll("nav button")) {
    if (button.dataset.view === name) button.setAttribute("aria-current", "page");
    else button.removeAttribute("aria-current");
  }
  drive?.pointing(false);
  drive?.tell("");
  scrollTo(0, 0);
  act(null, ENTER[name]);
}

function wire() {
  after.act = controls;
  $("stop").addEventListener("click", stop);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    if ($("confirm").open) $("confirm").close("no");
    stop();
  });
  for (const button of document.querySelectorAll("nav button")) button.addEventListener("click", () => view(button.dataset.view));
  for (const button of document.querySelectorAll("[data-command]")) {
    button.addEventListener("click", () => act(button, () => button.dataset.command === "torque-on" ? torqueOn() : post(`/${button.dataset.command}`)));
  }
  $("release").addEventListener("click", async (event) => {
    if (await confirmed("Torque goes off and the arm drops. Support it by hand first.", "It is supported")) {
      await act(event.target, () => post("/release", { confirm: true }));
    }
  });
  for (const slider of document.querySelectorAll(".rate")) slider.addEventListener("input", () => setRate(Number(slider.value) / 100));
  wireGuide();
  wireProgram();
  wireLogs();
  wireSetUp();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  $("look").addEventListener("click", () => page.view && page.view.look());
}

for (const end of ["from", "to"]) if (asked.has(end)) $("line-form").elements[end].value = asked.get(end);
wire();
connect();
act(null, async () => {
  const arm = page.arm = await request("/arm").catch((error) => {
    if (error.code === "CONFIG") [shown, $("scene").textContent] = ["", error.message];
    throw error;
  });
  shown = arm.calibration_hash;
  $("arm-id").textContent = arm.arm_id;
  $("take-by-hand").hidden = !arm.simulated;
  $("gripper").hidden = !arm.gripper;
  page.view = armView("scene", arm);
  if (page.view) page.view.led = pointLed;
  drive = new Drive(post, page.view);
  makeJointRows();
  show(page.snapshot);
  if (asked.get("view") in ENTER) view(asked.get("view"));
});
