// Programs: steps in YAML, which the daemon checks as a whole and runs one after another.

import { $, act, fill, page, post, Refused, request, spoken, torqueOn, valueOf } from "/page.js";

const KEPT = "armctl-program";
const MOST = 60000;  // characters of a program
const [OPEN, DONE, WRONG] = ["\u2026", "\u2713", "\u2717"];
const DECIMALS = 4;  // of angles, in radians

const keep = () => localStorage.setItem(KEPT, $("program-text").value);

// A step behind those that are written.
function add(step) {
  const text = $("program-text").value.trimEnd();
  $("program-text").value = `${/^steps:/m.test(text) ? text : `${text}\nsteps:`.trimStart()}\n- ${step}\n`;
  $("program-text").scrollTop = $("program-text").scrollHeight;
  keep();
}

function addPose() {
  const q = page.snapshot?.joints.map(({ position_rad }) => position_rad) ?? [null];
  if (q.includes(null)) throw new Refused("not every servo has answered yet");
  add(`move: {joints_rad: [${q.map((angle) => angle.toFixed(DECIMALS)).join(", ")}]}`);
}

// A table of places as a path: x_m, y_m, z_m, and kind where wanted.
function pathOf(text) {
  const [head, ...rows] = text.trim().split(/\r?\n/).map((line) => line.split(",").map((cell) => cell.trim()));
  const columns = ["x_m", "y_m", "z_m"].map((name) => head.indexOf(name)), kind = head.indexOf("kind");
  if (columns.includes(-1)) throw new Refused(`the table begins with ${head.join(",").slice(0, 60)}; its first line has to name the columns x_m,y_m,z_m`);
  const points = rows.map((row, i) => {
    const place = columns.map((column) => Number(row[column] || NaN));
    if (!place.every(Number.isFinite)) throw new Refused(`line ${i + 2} of the table has no three numbers: ${row.join(",").slice(0, 60)}`);
    return `[${place.join(", ")}]`;
  });
  const kinds = kind < 0 ? "" : `, kinds: [${rows.map((row) => (row[kind] ?? "").replace(/\W/g, "") || "line").join(", ")}]`;
  return `path: {points_m: [${points.join(", ")}]${kinds}}`;
}

// A program takes the place of what was written, a table is a step of it.
async function open(file) {
  if (file.size > MOST) throw new Refused(`${file.name} has ${file.size} bytes, at most ${MOST} are a program`);
  const text = await file.text();
  if (/[.]csv$/i.test(file.name)) add(pathOf(text));
  else {
    $("program-text").value = text;
    $("program-name").value = file.name.replace(/[.][^.]*$/, "").replace(/[^A-Za-z0-9._-]/g, "-");
    keep();
  }
}

function save() {
  const link = Object.assign(document.createElement("a"), {
    href: URL.createObjectURL(new Blob([$("program-text").value])), download: `${valueOf($("program-name"))}.yaml`,
  });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// A line of the list: a step, what there is to say of it, and whether it can be done or is.
function tell(step, text, mark) {
  const known = [...$("program-steps").children].findLast((item) => item.dataset.step === step && item.dataset.mark === OPEN);
  const item = known ?? $("program-steps").appendChild(document.createElement("li"));
  Object.assign(item.dataset, { step, mark });
  item.className = { [DONE]: "done", [WRONG]: "wrong" }[mark] ?? "";
  if (mark === OPEN) item.setAttribute("aria-current", "step");
  else item.removeAttribute("aria-current");
  item.replaceChildren(Object.assign(document.createElement("b"), { textContent: step }), Object.assign(document.createElement("span"), { textContent: text }));
}

const told = () => ({ name: valueOf($("program-name")), text: $("program-text").value });
const goesOn = (step) => step === null ? "" : ` A run goes on at step ${step}.`;

async function check() {
  $("program-steps").replaceChildren();
  $("program-figures").textContent = "";
  const { steps, resumed_at } = await post("/program/check", told());
  for (const { name, ok, text } of steps) tell(name, text, ok ? DONE : WRONG);
  const wrong = steps.filter(({ ok }) => !ok).length;
  $("program-figures").textContent = `${wrong ? `${wrong} of ${steps.length} steps cannot be done` : `all ${steps.length} steps can be done`}.${goesOn(resumed_at)}`;
}

async function run() {
  const program = { ...told(), from_step: $("program-anew").checked ? "1" : null };
  if (page.snapshot?.state === "off") await torqueOn();
  $("program-steps").replaceChildren();
  $("program-figures").textContent = `${program.name} is running`;
  try {
    const { steps, ended, stands_at, recording } = await post("/program/run", program);
    $("program-figures").textContent = ended ? `ended at step ${stands_at}: ${ended.code}: ${ended.text}.${goesOn(stands_at)}`
      : `${spoken(recording)}: ${steps.length} steps done`;
    if (ended) tell(stands_at, ended.text, WRONG);
    $("program-anew").checked = false;
  } catch (error) {
    $("program-figures").textContent = "";
    throw error;
  }
}

// A step of the program under way begins, or is done.
export function stepped({ step, text, done, number, of }) {
  tell(step, text, done ? DONE : OPEN);
  if (number) $("program-figures").textContent = `step ${number} of ${of}: ${text}`;
}

export async function enterProgram() {
  const { recordings } = await request("/recordings");
  fill($("program-take"), recordings.map(({ name }) => [name, spoken(name)]));
  $("program-takes").hidden = !recordings.length;
}

export function wireProgram() {
  const text = $("program-text"), file = $("program-file");
  text.value = localStorage.getItem(KEPT) ?? "";
  text.addEventListener("input", keep);
  file.addEventListener("change", () => act(null, async () => {
    const [chosen] = file.files;
    file.value = "";  // the same one may be chosen again, once it is mended
    if (chosen) await open(chosen);
  }, text));
  $("program-here").addEventListener("click", () => act(null, addPose, text));
  $("program-play").addEventListener("click", () => act(null, () => add(`play: {name: ${$("program-take").value}}`), text));
  $("program-save").addEventListener("click", () => act(null, save, text));
  $("program-check").addEventListener("click", (event) => act(event.target, check, text));
  $("program-run").addEventListener("click", (event) => act(event.target, run, text));
}
