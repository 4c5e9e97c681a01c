// Driving the arm from the page: a slider for each joint, a place for the tool, which a click in the picture writes, and
// buttons that lead it while they are held down. A page that is gone, hidden or cut off says nothing more, and the daemon
// then stops the arm by itself.

import { point } from "/geometry.js";
import { $, degrees, valueOf } from "/page.js";

const AXES = { forward: [1, 0, 0], back: [-1, 0, 0], left: [0, 1, 0], right: [0, -1, 0], up: [0, 0, 1], down: [0, 0, -1] };
const STANDING = ["holding", "off"];

export class Drive {
  // `post` asks the server, `view` shows the arm, or is null.
  constructor(post, view) {
    [this.post, this.view] = [post, view];
    this.joints = [];
    this.targets = new Map();  // of the joints that a slider was moved of, by index
    this.state = "unreachable";
    this.held = null;
    $("go").addEventListener("click", () => this.go({ joints_rad: this.wanted() }));
    $("go-reset").addEventListener("click", () => this.reset());
    $("tool-form").addEventListener("submit", (event) => {
      event.preventDefault();
      try {
        valueOf($("tool-place"));
      } catch (error) {
        this.tell(error.message, "tool-problem");
        return;
      }
      this.go({ point_m: this.place() }, "tool-problem");
    });
    $("tool-place").addEventListener("input", () => this.aimAt());
    $("tool-pick").hidden = !this.view;
    $("tool-pick").addEventListener("click", () => this.pointing($("tool-pick").getAttribute("aria-pressed") !== "true"));
    for (const button of document.querySelectorAll("[data-jog]")) this.wire(button, AXES[button.dataset.jog]);
    for (const button of document.querySelectorAll("[data-grip]")) button.addEventListener("click", () => this.grip(button.dataset.grip));
    addEventListener("blur", () => this.letGo());
    document.addEventListener("visibilitychange", () => this.letGo());
  }

  // Where the tool is to go [m], as it is written; null: nothing that can be read.
  place() {
    return point($("tool-place").value)?.map((value) => value / 1000) ?? null;
  }

  aimAt() {
    this.view?.aimAt($("tool-pick").getAttribute("aria-pressed") === "true" ? this.place() : null);
  }

  // Whether a click in the picture writes the place under it, at the height that is written.
  pointing(on) {
    if (!this.view) return;
    $("tool-pick").setAttribute("aria-pressed", String(on));
    $("pick-hint").hidden = !on;
    this.view.picked = on ? (under) => {
      const height_m = this.place()?.[2] ?? 0.1, place = under([0, 0, height_m], [0, 0, 1]);
      if (!place) return;
      $("tool-place").value = place.map((value) => Math.round(1000 * value)).join(", ");
      this.aimAt();
    } : null;
    this.aimAt();
  }

  // A slider for a joint, to be put into its row.
  slider({ name, limits_rad: [low, high] }) {
    const index = this.joints.length, slider = document.createElement("input");
    Object.assign(slider, { type: "range", min: degrees(low).toFixed(1), max: degrees(high).toFixed(1), step: "0.1", disabled: true });
    slider.setAttribute("aria-label", `where ${name} is to be, degrees`);
    slider.addEventListener("input", () => {
      this.targets.set(index, Number(slider.value) * Math.PI / 180);
      this.changed();
    });
    this.joints.push({ slider, low, high, at: null });
    return slider;
  }

  wanted() {
    return this.joints.map(({ at }, i) => this.targets.get(i) ?? at);
  }

  changed() {
    const any = this.targets.size > 0;
    $("go").disabled = !any || this.state !== "holding";
    $("go-reset").disabled = !any;
    const all = this.joints.every(({ at }) => at !== null);
    this.view?.aim(any && all && !$("view-arm").hidden ? this.wanted() : null);
  }

  reset() {
    this.targets.clear();
    this.tell("");
    this.joints.forEach(({ slider, at }) => { if (at !== null) slider.value = degrees(at); });
    this.changed();
  }

  // What the arm is now.
  show(state, joints) {
    this.state = state;
    joints.forEach(({ position_rad: at }, i) => {
      const joint = this.joints[i];
      if (!joint) return;
      joint.at = at;
      if (at !== null && !this.targets.has(i)) joint.slider.value = degrees(at).toFixed(1);
    });
    for (const { slider } of this.joints) slider.disabled = !STANDING.includes(state);
    for (const button of [$("tool-go"), ...document.querySelectorAll("[data-grip]")]) button.disabled = state !== "holding";
    for (const button of document.querySelectorAll("[data-jog]")) button.disabled = !["holding", "jogging"].includes(state);
    $("drive-hint").hidden = state !== "off";
    this.changed();
  }

  // What is wrong stands beside what asked for it.
  tell(text, place = "move-problem") {
    for (const id of ["move-problem", "tool-problem"]) {
      $(id).textContent = id === place ? text : "";
      $(id).hidden = id !== place || !text;
    }
  }

  go(where, place) {
    return this.ask("/move", where, place);
  }

  async grip(what) {
    const answer = await this.ask("/grip", { grip: what });
    if (answer && what === "close") this.tell(answer.gripped ? "" : "nothing is gripped");
  }

  async ask(path, body, place) {
    this.tell("");
    try {
      const answer = await this.post(path, body);
      this.reset();
      return answer;
    } catch (error) {
      this.tell(error.code === "STOPPED" ? "stopped, as somebody asked" : error.message, place);
      return null;
    }
  }

  wire(button, axis) {
    const end = () => { if (this.held === button) this.letGo(); };
    button.addEventListener("pointerdown", (event) => {
      button.setPointerCapture(event.pointerId);
      this.lead(button, axis);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(name, end);
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    button.addEventListener("keydown", (event) => {
      if ((event.key !== " " && event.key !== "Enter") || event.repeat) return;
      event.preventDefault();
      this.lead(button, axis);
    });
    button.addEventListener("keyup", end);
  }

  letGo() {
    if (this.held) delete this.held.dataset.held;
    this.held = null;
  }

  // Say how fast for as long as the button is held; each answer comes when the next word is due.
  async lead(button, axis) {
    this.letGo();
    this.tell("");
    this.held = button;
    button.dataset.held = "";
    const speed_m_s = Number($("jog-speed").value) / 1000;
    try {
      for (let begin = true; this.held === button; begin = false) {
        await this.post("/jog", { tool_m_s: axis.map((part) => part * speed_m_s), begin });
      }
    } catch (error) {
      this.tell(error.message, "tool-problem");
      if (this.held === button) this.letGo();
    }
  }
}
