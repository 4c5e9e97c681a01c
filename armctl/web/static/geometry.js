// Places and lines, in metres from the base unless they say otherwise.

export function point(text) {
  const numbers = text.split(",").map((part) => Number(part.trim() || NaN));
  return numbers.length === 3 && numbers.every(Number.isFinite) ? numbers : null;
}

// The line that is written beside the steps; null where none is.
export function wantedLine() {
  const form = document.getElementById("line-form").elements;
  const line = [point(form.from.value), point(form.to.value)];
  return line[0] && line[1] && Math.hypot(...minus(line[1], line[0])) > 1e-6 ? line : null;
}

export const minus = (a, b) => a.map((value, i) => value - b[i]);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);

// Distance of a point from the line through A and B, in millimetres.
export function distance(place, A, B) {
  const along = minus(B, A), from = minus(place, A);
  const share = dot(from, along) / dot(along, along);
  return 1000 * Math.hypot(...from.map((value, i) => value - share * along[i]));
}

export function progressAlong(place, A, B) {
  const along = minus(B, A);
  return dot(minus(place, A), along) / dot(along, along);
}

// How much of a line a tool path leads along, 0 to 1.
export function shareOf(track, [A, B]) {
  const shares = track.map((place) => Math.min(1, Math.max(0, progressAlong(place, A, B))));
  return Math.max(...shares, 0) - Math.min(...shares, 1);
}

// The part of a tool path that leads from A to B.
export function fromTo(track, A, B) {
  const nearest = (end, some) => some.reduce((best, place, i) => Math.hypot(...minus(place, end)) <= Math.hypot(...minus(some[best], end)) ? i : best, 0);
  const way = track.slice(nearest(A, track));
  return way.slice(0, nearest(B, way) + 1);
}

// What of a tool path is worth drawing beside a line: the way there is not.
export function onTheWay(track, line) {
  const way = line ? fromTo(track, ...line) : track;
  return way.length > 1 ? way : track;
}

// The tool path to compare: of a run only the part that the plan describes, of a take everything.
export function proper(recording) {
  if (!recording.plan_s) return recording.tool_m;
  const [begin, end] = recording.plan_s;
  return recording.tool_m.filter((_, i) => recording.time_s[i] >= begin && recording.time_s[i] <= end);
}
