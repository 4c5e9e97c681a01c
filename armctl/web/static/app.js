// The dashboard. Everything that comes from the daemon goes into text nodes and never into markup, so it cannot run as code.

import { chart, COLOURS, namesOf, repaint as repaintCharts } from "/charts.js";
import { Drive } from "/drive.js";
import { drawLive, remember } from "/live.js";
import { ArmView } from "/scene.js";

const token = takeToken();
const $ = (id) => document.getElementById(id);
const degrees = (rad) => rad * 180 / Math.PI;
const millimetres = (value) => value === null || value === undefined ? "–" : `${value.toFixed(1)} mm`;
let arm = null, snapshot = null, teaching = false, taking = null, running = false, takes = [];
let drive = null, view3d = null, logView = null, pathView = null;
let covered = [1, 0];  // of the line, in the take under way
const trail = [];
const TRAIL = 150;
const MOST_DRAWN = 12;
const tracks = new Map();  // tool paths of recordings, by name

function takeToken() {
  const found = new URLSearchParams(location.hash.slice(1)).get("token");
  if (found) {
    sessionStorage.setItem("armctl-token", found);
    history.replaceState(null, "", location.pathname);
  }
  return found || sessionStorage.getItem("armctl-token") || "";
}

// Asks for a token where the address had none, or it opens nothing any more.
function logIn() {
  $("login").hidden = false;
  $("login").onsubmit = (event) => {
    event.preventDefault();
    sessionStorage.setItem("armctl-token", $("login-token").value.trim());
    location.reload();
  };
}

// ------------------------------------------------------------------------------------------------- requests

class Refused extends Error {}

async function request(path, { method = "GET", body } = {}) {
  const headers = { "X-Armctl-Token": token };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(`/api${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new Refused("the dashboard's server does not answer; is `armctl web` running?");
  }
  const answer = await response.json().catch(() => null);
  if (response.ok) return answer;
  const error = answer && answer.error;
  throw new Refused(error ? `${error.code}: ${error.reasons.join("; ")}` : `the server answered ${response.status}`);
}

const post = (path, body = {}) => request(path, { method: "POST", body });

function tell(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

// Does what a button asks for. The button is disabled until it is done. A refusal is shown.
async function act(button, work) {
  tell("");
  if (button) button.disabled = true;
  try {
    return await work();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    tell(error.message);
    return null;
  } finally {
    if (button) button.disabled = false;
    controls();
  }
}

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

function confirmed(text, yes) {
  $("confirm-text").textContent = text;
  $("confirm-yes").textContent = yes;
  const dialog = $("confirm");
  if (dialog.open) dialog.close("no");
  dialog.returnValue = "no";
  dialog.show();  // not modal: STOP must work while a question is open
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

// ------------------------------------------------------------------------------------------------- live view

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/stream`);
  socket.onopen = () => socket.send(JSON.stringify({ token }));
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.kind === "snapshot") show(message.snapshot);
    else if (message.kind === "progress") progressed(message);
  };
  socket.onclose = (event) => {
    show(null);
    if (event.code === 1008) logIn();
    else setTimeout(connect, 1000);
  };
}

function show(latest) {
  snapshot = latest;
  const state = latest ? latest.state : "unreachable";
  if ($("state").textContent !== state) $("state").textContent = state;
  $("state").dataset.state = state;
  showFaults(latest ? latest.faults : []);
  const notice = latest && latest.notice && !latest.fault ? latest.notice : "";
  if ($("notice-text").textContent !== notice) $("notice-text").textContent = notice;
  $("notice").hidden = !notice;
  controls();
  if (!latest) return;
  latest.joints.forEach(showJoint);
  if (drive) drive.show(state, latest.joints);
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
    trail.push(place);
    if (trail.length > TRAIL) trail.shift();
    const line = wantedLine();
    $("line-error-part").hidden = !line;
    if (line) $("line-error").textContent = millimetres(distance(place, ...line));
    if (taking && line) showTeaching(place, latest.tool.speed_m_s, line);
  }
  drawArm(true);
  remember(latest);
  if (!$("view-live").hidden && !document.hidden) drawLive();
}

// What a card says to type, and which button here does the same.
const BUTTONS = { clear: "Clear the fault", release: "Release", "torque on": "Torque on", park: "Park", stop: "STOP" };
const pressed = (text) => text.replace(/(?:type )?`armctl (clear|release|torque on|park|stop)`/g, (_, name) => `press \u201c${BUTTONS[name]}\u201d`);
let cards = "";

// Where the hand is on its way, and how much of the line it has led the tool along.
function showTeaching(place, speed_m_s, [A, B]) {
  const share = Math.min(1, Math.max(0, progressAlong(place, A, B)));
  covered = [Math.min(covered[0], share), Math.max(covered[1], share)];
  const speed = speed_m_s === null ? "" : `, ${Math.round(1000 * speed_m_s)} mm/s`;
  $("teach-figures").textContent = `recording ${taking}: ${millimetres(distance(place, A, B))} off the line, ` +
    `${millimetres(1000 * Math.hypot(...minus(place, A)))} from its start${speed}, ${Math.round(100 * (covered[1] - covered[0]))} % of it covered`;
}

// A card for every fault, the worst first.
function showFaults(faults) {
  $("fault").hidden = !faults.length;
  const told = faults.map(({ code, servo_id, text, arm: doing, next, follows }) => [
    `${code}${servo_id === null ? "" : `, servo ${servo_id}`}`, text ?? "", follows ? `It follows from ${follows}.` : "", `The arm: ${doing}`, `Next: ${pressed(next)}`,
  ]);
  if (cards === (cards = JSON.stringify(told))) return;  // said aloud once
  $("faults").replaceChildren(...told.map(([title, ...lines]) => {
    const card = document.createElement("article"), heading = document.createElement("h2");
    heading.textContent = title;
    card.append(heading, ...lines.filter(Boolean).map((line) => Object.assign(document.createElement("p"), { textContent: line })));
    return card;
  }));
}

function showJoint(joint, index) {
  const row = $("joints").tBodies[0].rows[index];
  if (!row || !arm) return;
  const known = joint.position_rad !== null;
  const cells = row.cells;
  put(cells[1], known ? `${degrees(joint.position_rad).toFixed(1)}°` : "–", false);
  put(cells[3], known ? `${(100 * Math.abs(joint.load_ratio)).toFixed(0)} %` : "–", Math.abs(joint.load_ratio) > 0.8);
  put(cells[4], known ? `${joint.temperature_degC.toFixed(0)} °C` : "–", joint.temperature_degC >= arm.temperature_limit_degC);
  put(cells[5], known ? `${joint.voltage_V.toFixed(1)} V` : "–", known && (joint.voltage_V < arm.voltage_V[0] || joint.voltage_V > arm.voltage_V[1]));
  const stale = joint.age_s > 0.5;
  put(cells[6], stale ? "silent" : joint.torque_enabled ? "on" : "off", stale);
}

function put(cell, text, alarm) {
  if (cell.textContent !== text) cell.textContent = text;
  cell.className = alarm ? "alarm" : "";
}

function makeJointRows() {
  const body = $("joints").tBodies[0];
  for (const joint of arm.joints) {
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
  const state = snapshot ? snapshot.state : "unreachable";
  const command = (name) => document.querySelector(`[data-command="${name}"]`);
  command("torque-on").disabled = state !== "off";
  command("park").disabled = state !== "holding";
  command("pause").disabled = state !== "moving" || !(snapshot.rate > 0);
  command("resume").disabled = state !== "moving" || snapshot.rate > 0;
  $("release").disabled = state === "unreachable";
  teaching = state === "teaching";
  // A gap in what is heard of the arm does not end a take.
  if (!teaching && state !== "stalled" && state !== "unreachable") taking = null;
  $("teach-begin").disabled = !(state === "off" || state === "holding");
  $("take").disabled = !teaching;
  $("take").textContent = taking ? "End the take" : "Begin a take";
  $("teach-end").disabled = !teaching || taking !== null;
  // Between two runs of a refinement the arm holds.
  for (const id of ["run", "refine"]) $(id).disabled = running || !$("plan-choice").value || !(state === "holding" || state === "off");
}

// ------------------------------------------------------------------------------------------------- geometry

function point(text) {
  const numbers = text.split(",").map((part) => Number(part.trim() || NaN));
  return numbers.length === 3 && numbers.every(Number.isFinite) ? numbers : null;
}

function wantedLine() {
  const form = $("line-form").elements;
  const line = [point(form.from.value), point(form.to.value)];
  return line[0] && line[1] && Math.hypot(...minus(line[1], line[0])) > 1e-6 ? line : null;
}

const minus = (a, b) => a.map((value, i) => value - b[i]);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);

// Distance of a point from the line through A and B, in millimetres.
function distance(place, A, B) {
  const along = minus(B, A), from = minus(place, A);
  const share = dot(from, along) / dot(along, along);
  return 1000 * Math.hypot(...from.map((value, i) => value - share * along[i]));
}

function progressAlong(place, A, B) {
  const along = minus(B, A);
  return dot(minus(place, A), along) / dot(along, along);
}

// ------------------------------------------------------------------------------------------------- pictures

const calm = matchMedia("(prefers-reduced-motion: reduce)");

// What is drawn already takes the page's new colours.
function repaint() {
  repaintCharts();
  for (const made of [view3d, logView, pathView]) if (made) made.paint();
}

function drawArm(glide = false) {
  if (!view3d || ($("view-arm").hidden && $("view-guide").hidden) || document.hidden || !snapshot) return;
  const q = snapshot.joints.map((joint) => joint.position_rad);
  if (q.includes(null)) return;
  view3d.pose(q, glide && !calm.matches);
  view3d.curve("line", wantedLine() || [], "--red", true);
  view3d.curve("trail", trail, "--ok");
}

// A view in an element, of the arm where one is given; or why there is none.
function armView(id, arm) {
  try {
    const made = new ArmView($(id));
    if (arm) made.setArm(arm);
    return made;
  } catch (error) {
    $(id).textContent = `This browser draws nothing in 3D (${error.message}); turn WebGL on to see the arm.`;
    return null;
  }
}

// ------------------------------------------------------------------------------------------------- the guide

function showTakes() {
  $("takes").replaceChildren(...takes.map((take) => {
    const item = document.createElement("li");
    const box = document.createElement("input");
    const label = document.createElement("label");
    box.type = "checkbox";
    box.checked = take.chosen;
    box.addEventListener("change", () => {
      take.chosen = box.checked;
      act(null, drawGuide);
    });
    const line = wantedLine(), off = tracks.has(take.name) && line ? offLine(tracks.get(take.name), line) : null;
    const figures = `: ${take.duration.toFixed(1)} s` + (off ? `, ${millimetres(off[0])} off the line on average, ${millimetres(off[1])} at most` : "");
    label.append(box, take.name + figures);
    item.append(label);
    return item;
  }));
}

async function loadTakes() {
  const { recordings } = await request("/recordings");
  const chosen = new Set(takes.filter((take) => take.chosen).map((take) => take.name));
  const known = new Set(takes.map((take) => take.name));
  takes = recordings.filter((one) => !one.name.startsWith("run-")).map((one) => ({
    name: one.name, duration: one.duration_s, chosen: known.size ? chosen.has(one.name) || !known.has(one.name) : true,
  }));
  showTakes();
  await drawGuide();
}

// The part of a tool path that leads from A to B.
function fromTo(track, A, B) {
  const nearest = (end, some) => some.reduce((best, place, i) => Math.hypot(...minus(place, end)) <= Math.hypot(...minus(some[best], end)) ? i : best, 0);
  const way = track.slice(nearest(A, track));
  return way.slice(0, nearest(B, way) + 1);
}

// How far a take is off the line [mm], on average and at most.
function offLine(track, [A, B]) {
  const off = fromTo(track, A, B).map((place) => distance(place, A, B));
  return [off.reduce((sum, one) => sum + one, 0) / off.length, Math.max(...off)];
}

// The chosen takes in space, beside the plan and its last run.
async function drawGuide() {
  if (!view3d || $("view-guide").hidden) return;
  const chosen = takes.filter((take) => take.chosen).slice(0, MOST_DRAWN).map((take) => take.name);
  await Promise.all(chosen.filter((name) => !tracks.has(name)).map(async (name) => {
    tracks.set(name, (await request(`/recordings/${encodeURIComponent(name)}`)).tool_m);
  }));
  view3d.keep(["line", "trail", "plan", "run"]);
  chosen.forEach((name, i) => view3d.curve(`take ${name}`, tracks.get(name), COLOURS[i % COLOURS.length]));
  $("guide-names").replaceChildren(...namesOf(chosen));
  showTakes();
}

// A plan's path with its intermediate points, and, where there is one, its run's.
function drawPlan({ plan, tool_m }, run = []) {
  if (!view3d) return;
  view3d.curve("plan", tool_m, "--blue");
  view3d.balls(plan.waypoints_rad.slice(1, -1).map((q) => view3d.toolAt(q)), "--blue");
  view3d.curve("run", run, "--ok");
}

function freeName(stem) {
  const taken = new Set(takes.map((take) => take.name));
  for (let i = 1; ; i++) if (!taken.has(`${stem}-${i}`)) return `${stem}-${i}`;
}

async function toggleTake() {
  if (taking) {
    const name = taking;
    await post("/take/end");
    taking = null;
    $("teach-figures").textContent = `${name} is saved`;
    await loadTakes();
  } else {
    const name = freeName($("take-name").value || "take");
    await post("/take/begin", { name });
    [taking, covered] = [name, [1, 0]];
  }
}

const generations = { x: [], best: [], mean: [] };

function progressed(message) {
  if (message.warning) tell(`${message.warning}: ${message.text}`);
  else if (message.round) $("run-figures").textContent = `after ${message.runs} of at most ${message.of} runs, ${roundText(message.round)}`;
  else converge(message);
}

const roundText = (round) => `round ${round.round}: ${millimetres(round.mean_error_mm)} off the line on average, ` +
  `${millimetres(round.max_error_mm)} at most, ${round.kept ? "kept" : "not kept"}`;

function converge({ generation, best, mean }) {
  generations.x.push(generation);
  generations.best.push(best);
  generations.mean.push(mean);
  $("optimise-figures").textContent = `generation ${generation}: ${best.toFixed(2)} mm`;
  return drawGenerations();
}

function drawGenerations() {
  $("convergence").hidden = false;
  const { x, best, mean } = generations;
  chart("convergence", { x: "generation", y: "mean error, mm", log: true }).draw([{ name: "best", x, y: best }, { name: "average", x, y: mean }]);
}

async function optimise(form) {
  const line = wantedLine();
  if (!line) throw new Refused("the line needs two different points; each point has three numbers");
  const chosen = takes.filter((take) => take.chosen).map((take) => take.name);
  if (!chosen.length) throw new Refused("choose at least one take above");
  Object.values(generations).forEach((list) => { list.length = 0; });
  const { plans } = await request("/plans");
  const taken = new Set(plans.map((plan) => plan.name));
  const via = Number(form.elements.via.value);
  let stem = $("take-name").value || "line";
  for (let i = 2; taken.has(`${stem}-via${via}`); i++) stem = `${$("take-name").value || "line"}-${i}`;
  const result = await post("/optimize", {
    name: stem, recordings: chosen, from_m: line[0], to_m: line[1], via: [via], duration_s: Number(form.elements.duration_s.value), seed: 0,
  });
  const [plan] = result.plans;
  generations.best = result.history.best_cost_mm;  // all generations: progress messages contained only some of them
  generations.mean = result.history.mean_cost_mm;
  generations.x = generations.best.map((_, i) => i);
  drawGenerations();
  $("optimise-figures").textContent = `genetic algorithm ${millimetres(result.ga.mean_error_mm)}, exact optimum ` +
    `${millimetres(result.exact.mean_error_mm)}; predicted distance from the line with ${plan.via} points: ` +
    `${millimetres(plan.predicted_mean_error_mm)} on average, ${millimetres(plan.predicted_max_error_mm)} at most`;
  await loadPlanChoice(plan.name);
  drawPlan(await request(`/plans/${encodeURIComponent(plan.name)}`));
}

async function loadPlanChoice(wanted) {
  const { plans } = await request("/plans");
  const known = plans.map((plan) => [plan.name, `${plan.name} (${millimetres(plan.predicted_mean_error_mm)} predicted)`]);
  fill($("plan-choice"), known.length ? known : [["", "none yet: optimise first"]], wanted);
  controls();
}

function fill(select, rows, wanted) {
  const before = wanted ?? select.value;
  select.replaceChildren(...rows.map(([value, text]) => new Option(text, value)));
  if (rows.some(([value]) => value === before)) select.value = before;
}

async function run(refine = 0) {
  running = true;
  try {
    await runPlan(refine);
  } finally {
    running = false;
  }
}

async function runPlan(refine) {
  const name = $("plan-choice").value;
  let result;
  try {
    if (snapshot.state === "off") {
      $("run-figures").textContent = "torque is coming on";
      await post("/torque-on");
    }
    $("run-figures").textContent = `${name} is running`;
    result = await post(`/plans/${encodeURIComponent(name)}/run`, { refine });
  } catch (error) {
    $("run-figures").textContent = "the run failed";
    throw error;
  }
  $("run-figures").textContent = `${result.recording}: ${millimetres(result.mean_error_mm)} off the line on average, ` +
    `${millimetres(result.max_error_mm)} at most, in ${result.duration_s.toFixed(1)} s (by the encoders; predicted on perfect ` +
    `servos ${millimetres(result.predicted_mean_error_mm)} and ${millimetres(result.predicted_max_error_mm)})`;
  const recorded = async (one) => proper(await request(`/recordings/${encodeURIComponent(one)}`));
  const [plan, measured] = await Promise.all([request(`/plans/${encodeURIComponent(name)}`), recorded(result.recording)]);
  drawPlan(plan, measured);
  const paths = [["predicted", plan.tool_m], ["measured", measured]];
  if (result.rounds) {
    const [first] = result.rounds, count = result.rounds.reduce((sum, round) => sum + round.recordings.length, 0);
    $("run-figures").textContent = `${result.ended ? `ended before its time: ${result.ended.code}: ${result.ended.text}. ` : ""}` +
      `The best of ${count} runs: ${$("run-figures").textContent}; the first one: ${millimetres(first.mean_error_mm)} and ${millimetres(first.max_error_mm)}`;
    paths[0] = ["first run", await recorded(first.recordings[0])];
    await loadPlanChoice(result.plan.split("/").pop().replace(/\.json$/, ""));
  }
  $("run-plot").hidden = false;
  const A = plan.plan.from_m, B = plan.plan.to_m;
  drawDeviation("run-plot", paths, A, B);
}

// The tool path to compare: of a run only the part that the plan describes, of a take everything.
function proper(recording) {
  if (!recording.plan_s) return recording.tool_m;
  const [begin, end] = recording.plan_s;
  return recording.tool_m.filter((_, i) => recording.time_s[i] >= begin && recording.time_s[i] <= end);
}

function drawDeviation(id, paths, A, B) {
  const curves = paths.map(([name, path]) => {
    const places = fromTo(path, A, B).map((place) => [100 * progressAlong(place, A, B), distance(place, A, B)]).sort(([a], [b]) => a - b);
    return { name, x: places.map(([x]) => x), y: places.map(([, y]) => y) };
  });
  chart(id, { x: "along the line, %", y: "off the line, mm", low: 0 }).draw(curves);
}

// ------------------------------------------------------------------------------------------------- comparison

const shown = { recordings: new Set(), plans: new Set() };

async function loadCompare() {
  const [{ recordings }, { plans }] = await Promise.all([request("/recordings"), request("/plans")]);
  rows("recordings", recordings, (one) => [`${one.duration_s.toFixed(1)} s`, millimetres(one.mean_error_mm), millimetres(one.max_error_mm)]);
  rows("plans", plans, (one) => [one.via, millimetres(one.predicted_mean_error_mm), millimetres(one.predicted_max_error_mm)]);
  await drawCompare();
}

function rows(kind, items, figures) {
  const body = $(kind).tBodies[0];
  body.replaceChildren();
  for (const name of shown[kind]) if (!items.some((one) => one.name === name)) shown[kind].delete(name);
  for (const one of items) {
    const row = body.insertRow();
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = shown[kind].has(one.name);
    box.setAttribute("aria-label", `show ${one.name}`);
    box.addEventListener("change", () => act(null, async () => {
      shown[kind][box.checked ? "add" : "delete"](one.name);
      await drawCompare();
    }));
    const label = document.createElement("label");
    label.append(box, one.name);
    const name = document.createElement("th");
    name.scope = "row";
    name.append(label);
    row.append(name);
    figures(one).forEach((text) => { row.insertCell().textContent = text; });
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "Delete";
    button.setAttribute("aria-label", `delete ${one.name}`);
    button.addEventListener("click", async () => {
      if (!await confirmed(`Delete ${one.name}?`, "Delete")) return;
      await act(button, () => request(`/${kind}/${encodeURIComponent(one.name)}`, { method: "DELETE" }));
      tracks.delete(one.name);  // another take may have that name next
      await act(null, loadCompare);
    });
    row.insertCell().append(button);
  }
  if (!items.length) {
    const cell = body.insertRow().insertCell();
    cell.colSpan = 5;
    cell.textContent = "none yet";
  }
}

async function drawCompare() {
  const paths = await Promise.all([
    ...[...shown.recordings].map(async (name) => [name, proper(await request(`/recordings/${encodeURIComponent(name)}`))]),
    ...[...shown.plans].map(async (name) => [name, (await request(`/plans/${encodeURIComponent(name)}`)).tool_m]),
  ]);
  $("compare-hint").hidden = paths.length > 0;
  $("compare-plots").hidden = paths.length === 0;
  if (!paths.length) return;
  const line = wantedLine();
  if (line) drawDeviation("deviation", paths, ...line);
  $("paths-names").replaceChildren(...namesOf(paths.map(([name]) => name)));
  pathView ??= armView("paths", null);
  if (pathView) pathView.paths([...paths.map(([, path], i) => [path, COLOURS[i % COLOURS.length], false]), [line || [], "--red", true]]);
}

// ------------------------------------------------------------------------------------------------- logs

let openLog = null;

async function loadLogs() {
  const { logs } = await request("/logs");
  fill($("log-choice"), logs.map((log) => [log.name, `${log.name} (${(log.bytes / 1e6).toFixed(1)} MB)`]));
  if ($("log-choice").value) await showLog($("log-choice").value);
}

async function showLog(name) {
  const log = await request(`/logs/${encodeURIComponent(name)}`);
  openLog = log;
  chart("log-plot", { x: "time, s", y: "angle, °" }).draw(log.names.map((name, i) => ({
    name, x: log.time_s, y: log.position_rad.map((row) => degrees(row[i])),
  })));
  const scrub = $("scrub");
  scrub.max = String(Math.max(0, log.time_s.length - 1));
  scrub.disabled = log.time_s.length === 0;
  scrub.value = scrub.max;
  scrubTo(Number(scrub.value));
  $("log-download").hidden = false;
}

function scrubTo(index) {
  if (!openLog || !openLog.time_s.length) return;
  const time = openLog.time_s[index];
  $("scrub-time").textContent = `${time.toFixed(1)} s`;
  logView ??= armView("log-scene", arm);
  if (logView) {
    logView.pose(openLog.position_rad[index]);
    logView.curve("trail", openLog.tool_m.slice(Math.max(0, index - 100), index + 1), "--ok");
  }
  chart("log-plot").mark(time);
}

async function download() {
  const response = await fetch(`/api/logs/${encodeURIComponent(openLog.name)}/file`, { headers: { "X-Armctl-Token": token } });
  if (!response.ok) throw new Refused(`the log could not be fetched (${response.status})`);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = openLog.name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// ------------------------------------------------------------------------------------------------- wiring

// The arm is drawn where it is looked at.
function showArmIn(slot) {
  $(slot).prepend($("scene"));
  if (view3d) view3d.keep(["line", "trail"]);
  drawArm();
}

const ENTER = {
  arm: () => showArmIn("arm-slot"), live: drawLive,
  guide: async () => {
    showArmIn("guide-slot");
    await loadTakes();
    await loadPlanChoice();
  },
  compare: loadCompare, logs: loadLogs,
};

function view(name) {
  for (const section of document.querySelectorAll("main > section")) section.hidden = section.id !== `view-${name}`;
  for (const button of document.querySelectorAll("nav button")) {
    if (button.dataset.view === name) button.setAttribute("aria-current", "page");
    else button.removeAttribute("aria-current");
  }
  act(null, ENTER[name]);
}

function wire() {
  $("stop").addEventListener("click", stop);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    if ($("confirm").open) $("confirm").close("no");
    stop();
  });
  for (const button of document.querySelectorAll("nav button")) button.addEventListener("click", () => view(button.dataset.view));
  for (const button of document.querySelectorAll("[data-command]")) {
    button.addEventListener("click", () => act(button, () => post(`/${button.dataset.command}`)));
  }
  $("release").addEventListener("click", async (event) => {
    if (await confirmed("Torque goes off and the arm drops. Support it by hand first.", "It is supported")) {
      await act(event.target, () => post("/release", { confirm: true }));
    }
  });
  $("teach-begin").addEventListener("click", async (event) => {
    const needed = snapshot && snapshot.joints.some((joint) => joint.torque_enabled);
    if (needed && !await confirmed("The arm goes limp and drops. Support it by hand first.", "It is supported")) return;
    await act(event.target, () => post("/teach/begin", { confirm: true }));
  });
  $("take").addEventListener("click", (event) => act(event.target, toggleTake));
  $("teach-end").addEventListener("click", (event) => act(event.target, () => post("/teach/end")));
  $("optimise-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act(event.submitter, () => optimise(event.target));
  });
  $("line-form").addEventListener("submit", (event) => event.preventDefault());
  $("line-form").addEventListener("input", () => {
    const line = wantedLine();
    $("line-hint").textContent = line ? `${(1000 * Math.hypot(...minus(line[1], line[0]))).toFixed(0)} mm long` : "write three numbers for each point, separated by commas";
    showTakes();
  });
  $("plan-choice").addEventListener("change", controls);
  $("run").addEventListener("click", (event) => act(event.target, () => run()));
  $("refine").addEventListener("click", (event) => act(event.target, () => {
    const most = $("refine-most");
    if (!most.checkValidity()) throw new Refused("the further runs are a whole number from 1 to 20");
    return run(Number(most.value));
  }));
  $("log-choice").addEventListener("change", (event) => act(null, () => showLog(event.target.value)));
  $("log-download").addEventListener("click", (event) => act(event.target, download));
  $("scrub").addEventListener("input", (event) => scrubTo(Number(event.target.value)));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  $("look").addEventListener("click", () => view3d && view3d.look());
}

wire();
connect();
act(null, async () => {
  arm = await request("/arm");
  $("arm-id").textContent = arm.arm_id;
  view3d = armView("scene", arm);
  drive = new Drive(post, (q) => view3d && view3d.aim(q));
  makeJointRows();
});
