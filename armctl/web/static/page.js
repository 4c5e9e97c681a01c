// What every view of the page shares: its elements, the server behind it, and what is known of the arm.

import { point } from "/geometry.js";
import { ArmView } from "/scene.js";

export const $ = (id) => document.getElementById(id);
export const degrees = (rad) => rad * 180 / Math.PI;
// A name for people: the instant that a program put into it, as a time of day.
export const spoken = (name) => name.replace(/-\d{4}(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)\.\d+Z$/, ", $1-$2 $3:$4:$5");
export const millimetres = (value) => value === null || value === undefined ? "–" : `${value.toFixed(1)} mm`;
// The arm as the server describes it, its last snapshot, the view that shows it, and whether who is here may only look.
export const page = { arm: null, snapshot: null, view: null, looksOnly: false };
// Every view that was made.
export const views = [];
// What is to be looked at again after each request.
export const after = { act: () => {} };
// What the address says behind its `#`: a token; and a `view` to begin with, and a line `from` and `to`, where somebody is led.
export const asked = new URLSearchParams(location.hash.slice(1));
export const token = takeToken();

function takeToken() {
  const found = asked.get("token");
  if (found) {
    sessionStorage.setItem("armctl-token", found);
    history.replaceState(null, "", location.pathname);
  }
  return found || sessionStorage.getItem("armctl-token") || "";
}

// Asks for a token where the address had none, or it opens nothing any more.
export function logIn() {
  $("login").hidden = false;
  if (token) beside($("login-token"), "this token opens nothing, or nothing any more; copy it as it was printed");
  $("login").onsubmit = (event) => {
    event.preventDefault();
    sessionStorage.setItem("armctl-token", $("login-token").value.trim());
    location.reload();
  };
}

// What was not done, and why; it stands beside the field, where there is one.
export class Refused extends Error {
  constructor(message, field = null, code = "") {
    super(message);
    [this.field, this.code] = [field, code];
  }
}

// ------------------------------------------------------------------------------------------------- fields

const NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$/;
const FARTHEST_M = 10;
const LONGEST = 40;
// Of what was written, what is told again.
const quoted = (value) => value ? `"${value.length > LONGEST ? `${value.slice(0, LONGEST)}\u2026` : value}"` : "nothing";
const place = (unit, scale, example) => (value) => {
  const to = point(value);
  if (!to) return `${quoted(value)} is no place: write three numbers in ${unit} with commas between them, such as ${example}`;
  return to.some((one) => Math.abs(one) > FARTHEST_M * scale) ? `${quoted(value)} is farther than ${FARTHEST_M * scale} ${unit} from the base` : "";
};
// What is wrong with a value, by what the field is (`data-is`); nothing: it is as it may be.
const RULES = {
  name: (value) => NAME.test(value) ? "" : `${quoted(value)} is no name: write up to 64 letters, digits, ".", "_" or "-", the first a letter or a digit, such as my-arm`,
  metres: place("m", 1, "0.18, 0, 0.1"),
  millimetres: place("mm", 1000, "180, 0, 100"),
  number: (value, { min, max, step }) => {
    const number = Number(value || NaN), whole = Number(step || 1) === 1;
    return number >= Number(min) && number <= Number(max) && !(whole && number % 1) ? "" : `write a ${whole ? "whole " : ""}number from ${min} to ${max}`;
  },
};

// What is told, with commands between backquotes as such.
export const words = (text) => text.split("`").map((part, i) => i % 2 ? Object.assign(document.createElement("code"), { textContent: part }) : part);

// Say beside a field what is wrong with it; nothing: not any more.
export function beside(field, text) {
  const id = field.dataset.problem ?? `${field.id || field.name}-problem`;
  let told = $(id);
  if (!told) {
    told = Object.assign(document.createElement("p"), { id, className: "alarm" });
    told.setAttribute("role", "alert");
    (field.closest("label") ?? field).after(told);
  }
  told.textContent = text;
  told.hidden = !text;
  if (field.type !== "submit") field.setAttribute("aria-invalid", String(Boolean(text)));
  field.setAttribute("aria-describedby", id);
}

const wrong = (field) => RULES[field.dataset.is]?.(field.value.trim(), field) ?? "";

// The value of a field.
export function valueOf(field) {
  const text = wrong(field);
  if (text) throw new Refused(text, field);
  beside(field, "");
  return field.type === "number" ? Number(field.value) : field.value.trim();
}

document.addEventListener("input", ({ target }) => {
  if (target.dataset.is) beside(target, wrong(target));
});

export async function request(path, { method = "GET", body } = {}) {
  const headers = { "X-Armctl-Token": encodeURIComponent(token) };  // as it is, where it is one
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(`/api${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new Refused("the dashboard's server does not answer; is `armctl web` running?");
  }
  const role = response.headers.get("X-Armctl-Role");
  if (role) page.looksOnly = role === "look";
  const answer = await response.json().catch(() => null);
  if (response.ok) return answer;
  const error = answer && answer.error;
  throw new Refused(error ? `${error.code}: ${error.reasons.join("; ")}` : `the server answered ${response.status}`, null, error?.code);
}

export const post = (path, body = {}) => request(path, { method: "POST", body });

export function tell(text) {
  $("message").replaceChildren(...words(text));
  $("message").hidden = !text;
}

// Does what a button asks for. The button is disabled until it is done. A refusal is shown, beside a field where one is given.
export async function act(button, work, field = null) {
  tell("");
  if (field) beside(field, wrong(field));
  if (button) button.disabled = true;
  try {
    return await work();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (error.code === "NO_TOKEN") logIn();
    else if (error.field ?? field) beside(error.field ?? field, error.message);
    else tell(error.message);
    return null;
  } finally {
    if (button) button.disabled = false;
    after.act();
  }
}

export function confirmed(text, yes) {
  $("confirm-text").textContent = text;
  $("confirm-yes").textContent = yes;
  const dialog = $("confirm");
  if (dialog.open) dialog.close("no");
  dialog.returnValue = "no";
  dialog.show();  // not modal: STOP must work while a question is open
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

// A view in an element, of the arm where one is given; or why there is none.
export function armView(id, arm) {
  try {
    const made = new ArmView($(id));
    if (arm) made.setArm(arm);
    views.push(made);
    return made;
  } catch (error) {
    $(id).textContent = `This browser draws nothing in 3D (${error.message}); turn WebGL on to see the arm.`;
    return null;
  }
}

// The choices of a list [value, text]; the one of before stays chosen, if it is still there.
export function fill(select, rows, wanted) {
  const before = wanted ?? select.value;
  select.replaceChildren(...rows.map(([value, text]) => new Option(text, value)));
  if (rows.some(([value]) => value === before)) select.value = before;
}

// The arm holds itself from now on, and the simulator's hand is no longer needed.
export async function torqueOn() {
  await post("/torque-on");
  if (page.arm?.simulated) await post("/hand/let-go");
}
