// Setting an arm up: the questions of `armctl setup`; with simulated servos their hand does what is asked.

import { $, act, beside, page, post, request, valueOf } from "/page.js";

// The wizard's steps, as people call them, and what each is about.
const STEPS = {
  adapter: ["Adapter", "plug it in"], servos: ["Servos", "find every one"], joints: ["Joints", "turn each to both of its ends"],
  directions: ["Directions", "which way the tool goes"], rest: ["Rest pose", "as the arm may lie limp"], zeros: ["Zeros", "a pose that is known"],
  file: ["The arm's file", "written, and into the servos"], motion: ["First motion", "every joint a little"],
};
const WORDS = { kind: "Which arm is yours like", name: "Its name", port: "Port" };
const HANDY = /^(middle|bend|rest|zero|motion)$|[.](one_end|the_other_end|open|closed|free|went)$/;
const BEFORE = /^(kind|name|port)$/;  // asked before the first step
const PUSHED_DEG = 2.5;  // beyond its limits, against the stop
const LEAST_RAD = 0.03;  // that a joint is seen to turn by
let told = [], running = false, shown = -1, handing = false, swing = 0;

const radians = (deg) => deg * Math.PI / 180;
const wait = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));

// ------------------------------------------------------------------------------------------- what is asked

export const settingUp = () => running;

export async function enterSetUp() {
  showSetUp(await request("/setup"));
}

export function showSetUp(message) {
  [told, running] = [message.told, message.running];
  const last = told.at(-1) ?? {}, waits = running && Boolean(last.question);
  drawSteps();
  $("setup-begin").hidden = running || Boolean(last.arm);
  $("setup-held").hidden = !page.snapshot;
  $("setup-go").textContent = told.length ? "Go on" : "Begin";
  $("setup-question").hidden = !waits;
  $("setup-busy").hidden = !(running ? !waits : last.error);
  $("setup-busy").textContent = running ? "Looking at the servos …" : last.error?.message ?? "";
  $("setup-busy").className = running || last.error?.code === "INTERRUPTED" ? "hint" : "alarm";  // that was asked for
  $("setup-done").hidden = !last.arm;
  $("setup-arm").textContent = last.arm ? `Its file is ${last.arm}. Start the arm, then teach it a line.` : "";
  if (!waits) shown = -1;
  else if (shown !== told.length - 1) ask(last.question, shown = told.length - 1);
}

function drawSteps() {
  const done = new Map(told.filter(({ step }) => step).map(({ step }) => [step.name, step.text]));
  const current = running && !BEFORE.test(told.at(-1)?.question?.key) ? Object.keys(STEPS).find((name) => !done.has(name)) : null;
  $("setup-step").textContent = current ? STEPS[current][0] : done.size ? "The arm" : "Before the first step";
  $("setup-steps").replaceChildren(...Object.entries(STEPS).map(([name, [title, about]], i) => {
    const item = document.createElement("li");
    item.dataset.mark = done.has(name) ? "\u2713" : String(i + 1);
    item.className = done.has(name) ? "done" : "";
    if (name === current) item.setAttribute("aria-current", "step");
    item.append(Object.assign(document.createElement("b"), { textContent: title }),
      Object.assign(document.createElement("span"), { textContent: done.get(name) ?? about }));
    return item;
  }));
}

function ask({ key, text, choices }, number) {
  const lines = text.split("\n"), drawn = key === "again" ? 0 : lines.length - 1, written = key === "name" || (key === "port" && !choices.length);
  drawPose(lines.slice(0, drawn));
  $("setup-text").textContent = lines.slice(drawn).join("\n");
  $("setup-word-part").hidden = !written;
  $("setup-label").textContent = WORDS[key] ?? "";
  $("setup-word").value = "";
  $("setup-word").dataset.is = key === "name" ? "name" : "";
  beside($("setup-word"), "");
  const words = { q: "break off", "": written ? "Go on" : "Done" };
  $("setup-choices").replaceChildren(...(choices.length ? choices : [""]).filter((word) => word !== "q").map((word) => {
    const button = Object.assign(document.createElement("button"), { type: written ? "submit" : "button", textContent: words[word] ?? word });
    if (!written) button.addEventListener("click", () => answer(number, word));
    return button;
  }));
  leaveToHand(handing && HANDY.test(key));
  $("setup-hand").hidden = handing || !page.arm?.simulated || !HANDY.test(key);
  if (handing && HANDY.test(key)) byHand(number, key, text);
  else if (handing && key === "again" && text.includes("look at the tool")) answer(number, "again");
  else if (written) $("setup-word").focus();
  else $("setup-choices").firstChild.focus({ preventScroll: true });
}

// The pose of a question, which is drawn in characters for a terminal, each twice as high as it is wide.
function drawPose(lines) {
  const rows = lines.map((line) => [...line]), width = Math.max(0, ...rows.map(({ length }) => length));
  const radius = { "\u00b7": 0.8, o: 1.4, x: 1.4 }, parts = [];
  rows.forEach((row, y) => row.forEach((sign, x) => {
    if (sign === "_") parts.push(["rect", { x, y: 2 * y + 0.4, width: 1.05, height: 0.4 }]);
    else if (radius[sign]) parts.push(["circle", { cx: x + 0.5, cy: 2 * y, r: radius[sign], class: sign === "x" ? "tip" : sign === "o" ? "joint" : "" }]);
  }));
  parts.sort(([, a], [, b]) => (a.r ?? 0) - (b.r ?? 0));  // joints over links
  const picture = $("setup-picture");
  picture.setAttribute("viewBox", `-2 -2 ${width + 4} ${2 * rows.length + 2}`);
  picture.toggleAttribute("hidden", !rows.length);
  picture.replaceChildren(...parts.map(([kind, how]) => {
    const part = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [name, value] of Object.entries(how)) part.setAttribute(name, value);
    return part;
  }));
}

const answer = (number, word) => act(null, () => post("/setup/answer", { number, word }));

// --------------------------------------------------------------------------------------- the simulator's hand

const seen = () => request("/hand");

async function hold(q, free = null) {
  const { duration_s } = await post("/hand/hold", { joints_rad: q, free });
  await wait(duration_s + 0.3);
}

// What weighs on the arm is made up for.
async function holdExactly(q) {
  let aim = q;
  for (let i = 0; i < 3; i++) {
    await hold(aim);
    const { joints_rad } = await seen();
    aim = aim.map((value, j) => value + q[j] - joints_rad[j]);
  }
}

// Look at a joint until the question after that one: how far it turned, and which way. It counts while it has torque, for a
// free joint sags before; and it turns to where its servo reads most, and back.
async function watch(index, number) {
  let least = null, most = null;
  swing = 0;
  while (running && (told.length - 1 <= number || !told.at(-1).question)) {
    const { joints_rad: { [index]: at }, servos: { [index]: { torque_enabled: held, position_tick: tick } } } = await seen();
    if (held && !(tick >= least?.tick)) least = { at, tick };
    if (held && !(tick <= most?.tick)) most = { at, tick };
    swing = held ? most.at - least.at : swing;
    await wait(0.05);
  }
}

// Nobody presses a button for what the hand does.
function leaveToHand(does) {
  $("setup-handing").hidden = !does;
  $("setup-choices").hidden = does;
}

async function byHand(number, key, text) {
  handing = true;
  $("setup-hand").hidden = true;
  leaveToHand(true);
  const done = await act(null, async () => {
    const { joints, gripper, joints_rad } = await seen(), [, name, what] = key.match(/^(?:(.*)[.])?(.*)$/);
    const index = joints.findIndex((joint) => joint.name === name);
    const q = joints.map(({ limits_deg: [low, high] }) => radians((low + high) / 2));
    const say = async (word) => { await post("/setup/answer", { number, word }); return true; };
    if (what === "went") return say(swing > LEAST_RAD ? "yes" : swing < -LEAST_RAD ? "no" : "again");
    if (what === "free") {
      await post("/hand/hold", { joints_rad, free: index });
      await say("yes");
      watch(index, number);
      return true;
    }
    if (what === "zero") {
      for (const [, joint, deg] of text.matchAll(/(\S+) (-?\d+) deg/g)) q[joints.findIndex((one) => one.name === joint)] = radians(Number(deg));
    } else if (what === "bend") q.forEach((value, i) => { q[i] = value + 0.1 * (i - q.length / 2); });
    else if (what === "rest" || what === "motion") joints.forEach(({ rest_deg }, i) => { q[i] = radians(rest_deg); });
    else if (index >= 0) {
      const [low, high] = joints[index].limits_deg;
      q[index] = radians({ one_end: low - PUSHED_DEG, the_other_end: high + PUSHED_DEG, open: gripper?.open_deg, closed: gripper?.closed_deg }[what]);
    }
    await (what.endsWith("end") ? hold : holdExactly)(q);
    if (what === "rest" || what === "motion") await post("/hand/let-go");
    return say(what === "motion" ? "yes" : "");
  });
  if (done !== null) return;
  handing = false;
  leaveToHand(false);
}

// ---------------------------------------------------------------------------------------------------- wiring

export function wireSetUp() {
  $("setup-go").addEventListener("click", (event) => act(event.target, () => { handing = false; return post("/setup/begin"); }));
  $("setup-question").addEventListener("submit", (event) => {
    event.preventDefault();
    const field = $("setup-word"), number = told.length - 1;
    act(event.submitter, () => {
      if (!field.value.trim()) beside(field, `write ${field.dataset.is === "name" ? "a name, such as my-arm" : "the path of the port, such as /dev/ttyUSB0"}`);
      else return post("/setup/answer", { number, word: valueOf(field) });
      return null;
    }, field);
  });
  $("setup-hand").addEventListener("click", () => byHand(told.length - 1, told.at(-1).question.key, told.at(-1).question.text));
  $("setup-leave").addEventListener("click", (event) => act(event.target, () => post("/setup/answer", { number: told.length - 1, word: "q" })));
  $("setup-start").addEventListener("click", (event) => act(event.target, async () => {
    await post("/setup/start");
    location.reload();  // it is another arm
  }));
}
