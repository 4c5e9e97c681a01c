// Recordings and plans beside one another.

import { COLOURS, drawDeviation, namesOf } from "/charts.js";
import { onTheWay, proper, wantedLine } from "/geometry.js";
import { forget, offLine } from "/guide.js";
import { $, act, armView, confirmed, millimetres, page, post, request, spoken, torqueOn } from "/page.js";

let pathView = null;
// A figure of a column whose head says what it is in.
const short = (value) => value?.toFixed(1) ?? "–";
const errors = (one) => [short(one.mean_error_mm), short(one.max_error_mm)];
const shown = { recordings: new Set(), plans: new Set() };

export async function loadCompare() {
  const [{ recordings }, { plans }] = await Promise.all([request("/recordings"), request("/plans")]);
  const line = wantedLine();
  $("recordings-hint").textContent = line ? "Distance in mm from the wanted line." : "Distance in mm from the straight line between a recording's first and last point.";
  rows("recordings", recordings, (one) => [`${one.duration_s.toFixed(1)} s`, ...(line ? ["", ""] : errors(one))]);
  rows("plans", plans, (one) => [one.via, short(one.predicted_mean_error_mm), short(one.predicted_max_error_mm)]);
  await drawCompare();
  const made = [...$("recordings").tBodies[0].rows];
  for (let i = 0; line && i < recordings.length && made[i].isConnected && !$("view-compare").hidden; i++) {
    const told = errors(await offLine(recordings[i].name, line));
    [...made[i].cells].slice(2, 4).forEach((cell, k) => { cell.textContent = told[k]; });
  }
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
    label.append(box, spoken(one.name));
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
      forget(one.name);
      await act(null, loadCompare);
    });
    const cell = row.insertCell();
    cell.append(...(kind === "recordings" ? [playButton(one.name)] : []), button);
    button.disabled = page.looksOnly;
  }
  if (!items.length) {
    const cell = body.insertRow().insertCell();
    cell.colSpan = 5;
    cell.textContent = "none yet";
  }
}

function playButton(name) {
  const button = Object.assign(document.createElement("button"), { type: "button", textContent: "Play", disabled: page.looksOnly });
  button.setAttribute("aria-label", `play ${name}`);
  button.addEventListener("click", () => act(button, async () => {
    if (page.snapshot?.state === "off") await torqueOn();
    $("play-figures").textContent = `${spoken(name)} is played: slowly to its begin, then as it was taught`;
    try {
      const { mean_error_mm, max_error_mm } = await post("/play", { name });
      $("play-figures").textContent = `${spoken(name)} was played, ${millimetres(mean_error_mm)} off what was taught on average, ${millimetres(max_error_mm)} at most`;
      await loadCompare();
    } catch (error) {
      $("play-figures").textContent = error.code === "STOPPED" ? "stopped, as somebody asked: the arm holds where it came to" : "";
      if (error.code !== "STOPPED") throw error;
    }
  }));
  return button;
}

async function drawCompare() {
  const paths = await Promise.all([
    ...[...shown.recordings].map(async (name) => [spoken(name), proper(await request(`/recordings/${encodeURIComponent(name)}`))]),
    ...[...shown.plans].map(async (name) => [spoken(name), (await request(`/plans/${encodeURIComponent(name)}`)).tool_m]),
  ]);
  $("compare-hint").hidden = paths.length > 0;
  $("compare-plots").hidden = paths.length === 0;
  if (!paths.length) return;
  const line = wantedLine();
  if (line) drawDeviation("deviation", paths, ...line);
  $("paths-names").replaceChildren(...namesOf(paths.map(([name]) => ({ name }))));
  pathView ??= armView("paths", null);
  if (pathView) pathView.paths([...paths.map(([, path], i) => [onTheWay(path, line), COLOURS[i % COLOURS.length], false]), [line || [], "--red", true]]);
}
