// The daemon's logs: what happened in them, one played, another one beside it.

import { chart } from "/charts.js";
import { $, act, armView, degrees, fill, page, Refused, request, token } from "/page.js";

const TRAIL = 100;
const FRAME_MS = 100;
// The log that is open, what happened in it, the one beside it, and the view of both.
let open = null, events = [], beside = null, view = null, playing = 0;

export async function loadLogs() {
  const { logs } = await request("/logs");
  const rows = logs.map((log) => [log.name, `${told(log.name)} (${(log.bytes / 1e6).toFixed(1)} MB)`]);
  fill($("log-choice"), rows.length ? rows : [["", "none yet"]]);
  fill($("log-beside"), [["", "no other"], ...rows]);
  if ($("log-choice").value) await showLog($("log-choice").value);
}

// A log's name for people: of what, when it began, which one, and whether it is written still.
const told = (name) => name.replace(/-(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)Z-/, " $1-$2-$3 $4:$5:$6 ").replace(/[.]mcap$/, "").replace(/[.]mcap[.]part$/, ", still open");
const track = (name) => request(`/logs/${encodeURIComponent(name)}`);
const happened = (expression) => request(`/logs/find?expression=${encodeURIComponent(expression)}`);

async function showLog(name, time_s = null) {
  open = await track(name);
  fill($("log-choice"), [...$("log-choice").options].map(({ value, text }) => [value, text]), name);
  chart("log-plot", { x: "time, s", y: "angle, °" }).draw(open.names.map((name, i) => ({
    name, x: open.time_s, y: open.position_rad.map((row) => degrees(row[i])),
  })));
  const scrub = $("scrub");
  hold();
  $("log-play").disabled = open.time_s.length === 0;
  scrub.max = String(Math.max(0, open.time_s.length - 1));
  scrub.disabled = open.time_s.length === 0;
  scrub.value = scrub.max;
  $("log-download").hidden = false;
  if (time_s === null) scrubTo(Number(scrub.value));
  else goTo(time_s);
  events = (await happened(`log:${name}`)).found.reverse();
  chart("log-plot").notch(events.map((event) => event.time_s));
  listEvents($("log-events"), events, (event) => { hold(); goTo(event.time_s); });
}

// The row of a log nearest to a time.
const nearest = (log, time_s) => {
  const next = log.time_s.findIndex((one) => one >= time_s);
  return next < 0 ? log.time_s.length - 1 : next;
};

function goTo(time_s) {
  if (!open || !open.time_s.length) return;
  $("scrub").value = String(nearest(open, time_s));
  scrubTo(Number($("scrub").value));
}

function scrubTo(index) {
  if (!open || !open.time_s.length) return;
  const time_s = open.time_s[index];
  $("scrub-time").textContent = `${time_s.toFixed(1)} s`;
  view ??= armView("log-scene", page.arm);
  if (view) {
    view.pose(open.position_rad[index]);
    view.curve("trail", open.tool_m.slice(Math.max(0, index - TRAIL), index + 1), "--ok");
    const other = beside && beside.time_s.length ? nearest(beside, time_s) : null;
    view.aim(other === null ? null : beside.position_rad[other]);
    view.curve("beside", other === null ? [] : beside.tool_m.slice(Math.max(0, other - TRAIL), other + 1), "--blue");
  }
  chart("log-plot").mark(time_s);
}

function hold() {
  clearInterval(playing);
  playing = 0;
  $("log-play").textContent = "Play";
}

// Go on from where the slider stands, as fast as it happened; from the end, begin again.
function play() {
  if (playing) return hold();
  const last_s = open.time_s.at(-1), at_s = open.time_s[Number($("scrub").value)], from_s = at_s < last_s ? at_s : open.time_s[0], begun = performance.now();
  $("log-play").textContent = "Pause";
  playing = setInterval(() => {
    const now_s = from_s + (performance.now() - begun) / 1000;
    goTo(now_s);
    if (now_s >= last_s || $("view-logs").hidden) hold();
  }, FRAME_MS);
}

// What happened, each with a button that leads there.
function listEvents(list, some, go, textOf = (event) => `${event.time_s.toFixed(1)} s`) {
  list.replaceChildren(...some.map((event) => {
    const item = document.createElement("li"), button = document.createElement("button");
    button.type = "button";
    button.textContent = textOf(event);
    button.addEventListener("click", () => go(event));
    const words = event.text.startsWith(event.code) ? event.text : [event.code, event.text].filter(Boolean).join(": ");
    item.append(button, words.replaceAll(" -> ", " \u2192 "));
    return item;
  }));
  if (!some.length) list.replaceChildren(Object.assign(document.createElement("li"), { textContent: "nothing" }));
}

async function search() {
  const { found, left_off, unread } = await happened($("log-words").value);
  $("log-found-hint").textContent = (left_off ? `the newest ${found.length} of ${found.length + left_off}` : `${found.length} found`) +
    (unread ? `; ${unread} older logs are still being read` : "");
  listEvents($("log-found"), found, (event) => act(null, () => showLog(event.log, event.time_s)), (event) => event.time.slice(5, 19).replace("T", " "));
}

async function download() {
  const response = await fetch(`/api/logs/${encodeURIComponent(open.name)}/file`, { headers: { "X-Armctl-Token": token } });
  if (!response.ok) throw new Refused(`the log could not be fetched (${response.status})`);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = open.name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

export function wireLogs() {
  $("log-choice").addEventListener("change", (event) => act(null, () => showLog(event.target.value)));
  $("log-beside").addEventListener("change", (event) => act(null, async () => {
    beside = event.target.value ? await track(event.target.value) : null;
    scrubTo(Number($("scrub").value));
  }));
  $("log-download").addEventListener("click", (event) => act(event.target, download));
  $("log-play").addEventListener("click", play);
  $("scrub").addEventListener("input", (event) => { hold(); scrubTo(Number(event.target.value)); });
  $("log-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act(event.submitter, search, $("log-words"));
  });
}
