// Teach a line by hand, straighten what was taught, run it: the steps of the guide.

import { chart, COLOURS, drawDeviation, namesOf } from "/charts.js";
import { distance, minus, onTheWay, point, progressAlong, proper, shareOf, wantedLine } from "/geometry.js";
import { $, act, after, confirmed, fill, millimetres, page, post, Refused, request, spoken, tell, torqueOn, valueOf } from "/page.js";

const MOST_DRAWN = 12;
// Of a line that a take shows [%]: less is not what was to be shown.
const LEAST_COVERED = 80;
// Of the takes; the plan is blue and its run green.
const TAKEN = [1, 3, 6, 7, 5, 4].map((i) => COLOURS[i]);
// The take that is recorded, and whether a plan runs.
export const guide = { taking: null, running: false };
// Of recordings, by name: the tool's path, and how far it is off lines, as the daemon says, by the line.
const tracks = new Map();
let takes = [], drawn = null, ran = false;
let covered = [1, 0];  // of the line, in the take under way

// Which step comes next is marked.
function showNext() {
  const some = takes.some((take) => take.chosen);
  const next = !wantedLine() ? "line" : guide.taking || !some ? "teach" : !$("plan-choice").value ? "optimise" : "run";
  for (const step of ["line", "teach", "optimise", "run"]) {
    if (step === next) $(`step-${step}`).setAttribute("aria-current", "step");
    else $(`step-${step}`).removeAttribute("aria-current");
  }
}

export function showTakes() {
  showNext();
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
    const off = tracks.get(take.name)?.off[wantedLine()];
    const figures = `: ${take.duration.toFixed(1)} s` +
      (off ? `, ${millimetres(off.mean_error_mm)} off the wanted line on average, ${millimetres(off.max_error_mm)} at most` : "");
    label.append(box, take.name + figures + (take.why && !take.chosen ? `; left out: ${take.why}` : ""));
    item.append(label);
    return item;
  }));
}

async function loadTakes() {
  const { recordings } = await request("/recordings");
  const chosen = new Set(takes.filter((take) => take.chosen).map((take) => take.name));
  const known = new Set(takes.map((take) => take.name));
  takes = recordings.filter((one) => !one.name.startsWith("run-")).map((one) => ({
    name: one.name, duration: one.duration_s, fresh: !known.has(one.name), chosen: known.size ? chosen.has(one.name) || !known.has(one.name) : true,
  }));
  showTakes();
  await drawGuide();
}

function track(name) {
  if (!tracks.has(name)) tracks.set(name, { tool_m: null, off: {} });
  return tracks.get(name);
}

// How far a recording is off a line.
export async function offLine(name, line) {
  const ends = new URLSearchParams([["from_m", line[0]], ["to_m", line[1]]].flatMap(([end, place]) => place.map((x) => [end, x])));
  return track(name).off[line] ??= await request(`/recordings/${encodeURIComponent(name)}/errors?${ends}`);
}

// Another recording may have that name next.
export const forget = (name) => tracks.delete(name);

// The chosen takes in space, beside the plan and its last run.
async function drawGuide() {
  if (!page.view || $("view-guide").hidden) return;
  const inSight = takes.filter((take) => take.chosen).slice(0, MOST_DRAWN), line = wantedLine();
  await Promise.all(inSight.map(async ({ name }) => {
    track(name).tool_m ??= (await request(`/recordings/${encodeURIComponent(name)}`)).tool_m;
    if (line) await offLine(name, line);
  }));
  for (const take of inSight.filter(({ fresh }) => fresh && line)) {
    const share = Math.round(100 * shareOf(tracks.get(take.name).tool_m, line));
    take.fresh = false;
    if (share < LEAST_COVERED) [take.chosen, take.why] = [false, `it leads along ${share} % of the line`];
  }
  const chosen = inSight.filter((take) => take.chosen).map((take) => take.name);
  page.view.keep(["line", "trail", "plan", "run"]);
  chosen.forEach((name, i) => page.view.curve(`take ${name}`, onTheWay(tracks.get(name).tool_m, line), TAKEN[i % TAKEN.length]));
  nameCurves(chosen, line);
  showTakes();
}

// Which curve in space is which.
function nameCurves(chosen, line) {
  $("guide-names").replaceChildren(...namesOf([
    ...chosen.map((name, i) => ({ name, colour: TAKEN[i % TAKEN.length] })), ...(line ? [{ name: "wanted line", colour: "--red" }] : []),
    ...(drawn ? [{ name: "plan", colour: "--blue" }] : []), ...(ran ? [{ name: "run", colour: "--ok" }] : []),
  ]));
}

// A plan's path with its intermediate points, which can be led elsewhere, and, where there is one, its run's.
function drawPlan(shown, run = []) {
  [drawn, ran] = [shown, run.length > 1];
  const { plan, tool_m } = shown;
  $("bend-form").hidden = !plan.via;
  fill($("bend-point"), Array.from({ length: plan.via }, (_, i) => [String(i + 1), String(i + 1)]));
  if (!page.view) return;
  page.view.curve("plan", tool_m, "--blue");
  page.view.balls(plan.waypoints_rad.slice(1, -1).map((q) => page.view.toolAt(q)), "--blue");
  page.view.curve("run", run, "--ok");
  nameCurves(takes.filter((take) => take.chosen).slice(0, MOST_DRAWN).map(({ name }) => name), wantedLine());
  showPoint();
}

const inMillimetres = (place) => place.map((value) => Math.round(10000 * value) / 10).join(", ");

// Where the chosen intermediate point is.
function showPoint() {
  const chosen = drawn && page.view && drawn.plan.waypoints_rad[Number($("bend-point").value)];
  if (chosen) $("bend-place").value = inMillimetres(page.view.toolAt(chosen));
}

// The plan that is drawn, with one of its points elsewhere; it is another plan.
async function bend() {
  const to = point(valueOf($("bend-place")));
  try {
    const bent = await post(`/plans/${encodeURIComponent(drawn.name)}/bend`, { point: Number($("bend-point").value), to_m: to.map((value) => value / 1000) });
    const { name, plan } = bent;
    $("optimise-figures").textContent = `${name}: predicted distance from the line ${millimetres(plan.predicted_mean_error_mm)} on average, ` +
      `${millimetres(plan.predicted_max_error_mm)} at most`;
    await loadPlanChoice(name);
    drawPlan(bent);
  } catch (error) {
    drawPlan(drawn);  // the point is where it was
    throw error;
  }
}

async function drawChosen() {
  const name = $("plan-choice").value;
  if (name) drawPlan(await request(`/plans/${encodeURIComponent(name)}`));
}

function freeName(stem) {
  const taken = new Set(takes.map((take) => take.name));
  for (let i = 1; ; i++) if (!taken.has(`${stem}-${i}`)) return `${stem}-${i}`;
}

async function toggleTake() {
  if (guide.taking) {
    const name = guide.taking;
    await post("/take/end");
    guide.taking = null;
    $("teach-figures").textContent = `${name} is saved`;
    await loadTakes();
  } else {
    const name = freeName(valueOf($("take-name")));
    await post("/take/begin", { name });
    [guide.taking, covered] = [name, [1, 0]];
    showNext();
  }
}

// The line that is written.
function lineToShow() {
  const { from, to } = $("line-form").elements;
  valueOf(from);
  valueOf(to);
  const line = wantedLine();
  if (!line) throw new Refused("the line's two points are the same; write two different ones", to);
  return line;
}

// One take by the simulator's hand: it carries the arm to the start, and leads it along the line. A take in which that did
// not happen is not kept.
async function takeByHand() {
  const line = lineToShow();
  if (!guide.taking) await toggleTake();
  const name = guide.taking;
  let led = false;
  try {
    const { duration_s } = await post("/hand", { from_m: line[0], to_m: line[1], seed: takes.length });
    await new Promise((resolve) => setTimeout(resolve, 1000 * duration_s));
    const share = Math.round(100 * (covered[1] - covered[0]));
    led = guide.taking === name && share >= LEAST_COVERED;
    if (!led) throw new Refused(guide.taking === name ? `the hand led the tool along ${Math.max(0, share)} % of the line only; the take is not kept`
      : "teaching ended before the hand had led the tool along the line; the take is not kept");
  } finally {
    if (guide.taking) await post("/take/end");
    guide.taking = null;
    if (!led) await request(`/recordings/${encodeURIComponent(name)}`, { method: "DELETE" }).catch(() => null);
    $("teach-figures").textContent = led ? `${name} is saved` : "";
    await loadTakes();
  }
}

const generations = { x: [], best: [], mean: [] };
// How many runs of a refinement were made; one that something disturbed counts, and is none of those to choose from.
let made = "";

export function progressed(message) {
  if (message.warning) tell(`${message.warning}: ${message.text}`);
  else if (message.round) {
    made = `after ${message.runs} of at most ${message.of} runs`;
    $("run-figures").textContent = `${made}, ${roundText(message.round)}`;
  }
  else converge(message);
}

const roundText = (round) => `round ${round.round}: ${millimetres(round.mean_error_mm)} off the wanted line on average, ` +
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
  const line = lineToShow();
  const chosen = takes.filter((take) => take.chosen).map((take) => take.name);
  if (!chosen.length) throw new Refused("choose at least one take above");
  Object.values(generations).forEach((list) => { list.length = 0; });
  const { plans } = await request("/plans");
  const taken = new Set(plans.map((plan) => plan.name));
  const via = valueOf(form.elements.via), duration_s = valueOf(form.elements.duration_s), wanted = valueOf($("take-name"));
  let stem = wanted;
  for (let i = 2; taken.has(`${stem}-via${via}`); i++) stem = `${wanted}-${i}`;
  const result = await post("/optimize", {
    name: stem, recordings: chosen, from_m: line[0], to_m: line[1], via: [via], duration_s, seed: 0,
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
  const known = plans.map((plan) => [plan.name, `${spoken(plan.name)} (${millimetres(plan.predicted_mean_error_mm)} predicted)`]);
  fill($("plan-choice"), known.length ? known : [["", "none yet: optimise first"]], wanted);
  showNext();
  after.act();
}

async function run(refine = 0) {
  guide.running = true;
  try {
    await runPlan(refine);
  } finally {
    guide.running = false;
  }
}

async function runPlan(refine) {
  const name = $("plan-choice").value;
  let result;
  try {
    if (page.snapshot.state === "off") {
      $("run-figures").textContent = "torque is coming on";
      await torqueOn();
    }
    $("run-figures").textContent = `${spoken(name)} is running`;
    result = await post(`/plans/${encodeURIComponent(name)}/run`, { refine, corrected: $("corrected").checked });
  } catch (error) {
    const stopped = error.code === "STOPPED";  // somebody wanted that
    $("run-figures").textContent = stopped ? "stopped, as somebody asked: the arm holds where it came to" : `the run failed: ${error.message}`;
    if (stopped) return;
    throw error;
  }
  $("run-figures").textContent = `${spoken(result.recording)}: ${millimetres(result.mean_error_mm)} off the wanted line on average, ` +
    `${millimetres(result.max_error_mm)} at most, in ${result.duration_s.toFixed(1)} s (by the encoders; predicted on perfect ` +
    `servos ${millimetres(result.predicted_mean_error_mm)} and ${millimetres(result.predicted_max_error_mm)})`;
  const recorded = async (one) => proper(await request(`/recordings/${encodeURIComponent(one)}`));
  const [plan, measured] = await Promise.all([request(`/plans/${encodeURIComponent(name)}`), recorded(result.recording)]);
  drawPlan(plan, measured);
  const paths = [["predicted", plan.tool_m, "--blue"], ["measured", measured, "--ok"]];
  if (result.rounds) {
    const [first] = result.rounds, count = result.rounds.reduce((sum, round) => sum + round.recordings.length, 0);
    $("run-figures").textContent = `${result.ended ? `ended before its time: ${result.ended.code}: ${result.ended.text}. ` : ""}` +
      `The best of ${count} runs, ${made}: ${$("run-figures").textContent}; the first one: ${millimetres(first.mean_error_mm)} and ${millimetres(first.max_error_mm)}`;
    paths[0] = ["first run", await recorded(first.recordings[0]), COLOURS[1]];
    await loadPlanChoice(result.plan.split("/").pop().replace(/\.json$/, ""));
  }
  $("run-plot").hidden = false;
  const A = plan.plan.from_m, B = plan.plan.to_m;
  drawDeviation("run-plot", paths, A, B);
}

// Where the hand is on its way, and how much of the line it has led the tool along.
export function showTeaching(place, speed_m_s, [A, B]) {
  const share = Math.min(1, Math.max(0, progressAlong(place, A, B)));
  covered = [Math.min(covered[0], share), Math.max(covered[1], share)];
  const speed = speed_m_s === null ? "" : `, ${Math.round(1000 * speed_m_s)} mm/s`;
  $("teach-figures").textContent = `recording ${guide.taking}: ${millimetres(distance(place, A, B))} off the wanted line, ` +
    `${millimetres(1000 * Math.hypot(...minus(place, A)))} from its start${speed}, ${Math.round(100 * (covered[1] - covered[0]))} % of it covered`;
}

export async function enterGuide() {
  showNext();
  await loadTakes();
  await loadPlanChoice();
  await drawChosen();
}

export function wireGuide() {
  $("teach-begin").addEventListener("click", async (event) => {
    const needed = page.snapshot && page.snapshot.joints.some((joint) => joint.torque_enabled);
    if (needed && !await confirmed("The arm goes limp and drops. Support it by hand first.", "It is supported")) return;
    await act(event.target, () => post("/teach/begin", { confirm: true }));
  });
  $("take").addEventListener("click", (event) => act(event.target, toggleTake));
  $("take-by-hand").addEventListener("click", (event) => act(event.target, takeByHand));
  $("teach-end").addEventListener("click", (event) => act(event.target, () => post("/teach/end")));
  $("optimise-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act(event.submitter, () => optimise(event.target), event.submitter);
  });
  $("line-form").addEventListener("submit", (event) => event.preventDefault());
  $("line-form").addEventListener("input", () => {
    const line = wantedLine();
    $("line-hint").textContent = line ? `${(1000 * Math.hypot(...minus(line[1], line[0]))).toFixed(0)} mm long` : "";
    showTakes();
  });
  $("line-form").addEventListener("change", () => act(null, drawGuide));
  $("plan-choice").addEventListener("change", () => act(null, drawChosen));
  $("bend-point").addEventListener("change", showPoint);
  $("bend-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act(event.submitter, bend, $("bend-place"));
  });
  $("run").addEventListener("click", (event) => act(event.target, () => run()));
  $("refine").addEventListener("click", (event) => act(event.target, () => {
    return run(valueOf($("refine-most")));
  }));
}

// A point that was led elsewhere in the picture.
export function pointLed(index, place) {
  $("bend-point").value = String(index + 1);
  $("bend-place").value = inMillimetres(place);
  act(null, bend, $("bend-place"));
}
