// The last minute of what the servos told, as curves.

import { chart } from "/charts.js";

const [MINUTE_S, LEAST_S] = [60, 10];
// As much of the last minute as there is.
const wide = (_, first_s) => [Math.min(-LEAST_S, first_s), 0];
const degrees = (rad) => rad * 180 / Math.PI;
// What is drawn where: how much of it is shown at least, and where it stands.
const TOLD = {
  "live-angle": [10, (joint) => degrees(joint.position_rad)],
  // What is commanded is for the tick that follows.
  "live-error": [2, (joint, { wanted_rad }) => wanted_rad === null || !joint.torque_enabled ? null : degrees(wanted_rad - joint.position_rad)],
  "live-load": [20, (joint) => 100 * joint.load_ratio],
  "live-heat": [8, (joint) => joint.temperature_degC],
  "live-supply": [2, (joint) => joint.voltage_V],
};
const seen = [];

// Remember a snapshot, which came now.
export function remember({ joints, cycle }) {
  const now_s = performance.now() / 1000;
  seen.push([now_s, joints, cycle]);
  while (now_s - seen[0][0] > MINUTE_S) seen.shift();
}

export function drawLive() {
  if (!seen.length) return;
  const [now_s, joints] = seen.at(-1), x = seen.map(([time_s]) => time_s - now_s);
  const bus = (name, of) => ({ name, x, y: seen.map(([, , cycle]) => of(cycle)) });
  for (const [id, [span, of]] of Object.entries(TOLD)) {
    chart(id, { x: "seconds", span, wide }).draw(joints.map(({ name }, i) => ({
      name, x, y: seen.map(([, then], k) => then[i].position_rad === null ? null : of(then[i], seen[Math.max(0, k - 1)][1][i])),
    })));
  }
  chart("live-bus", { x: "seconds", low: 0, span: 10, wide }).draw([
    bus("the bus, ms a tick", ({ bus_us }) => bus_us / 1000), bus("asked again, in a minute", ({ retries }) => retries),
  ]);
}
