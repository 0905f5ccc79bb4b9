// Words and geometry of the calibration page, without DOM.

export const LEVELS = { good: "OK", due: "WARN", missing: "ERROR", optional: "STALE" };
const RUN_LEVELS = { running: "WARN", asking: "WARN", done: "OK", failed: "ERROR", cancelled: "STALE" };

export function ageWords(days) {
  if (days === null || days === undefined) return "–";
  if (days < 1 / 24) return `${Math.max(0, Math.round(days * 1440))} min`;
  return days < 2 ? `${Math.round(days * 24)} h` : `${Math.round(days)} days`;
}

export function runLevel(state) {
  return RUN_LEVELS[state] ?? "STALE";
}

export function runTitle({ kind, subject }) {
  return kind === "camera" ? `Lens of the ${subject.replaceAll("_", " ")} camera` : `Glove ${subject}`;
}

// What the operator has to do now, in one sentence.
export function nextWords(run) {
  // The questions are those of the command line.
  if (run.state === "asking") return run.question.trim().replace(/:$/, ".");
  if (run.state === "failed") return run.problem;
  if (run.state === "cancelled") return "Ended without a result; nothing was written.";
  if (run.state === "done") return doneWords(run);
  const { camera } = run;
  if (run.request.kind === "camera" && !camera) return "Waiting for an image of the camera.";
  if (camera && camera.todo.length === 0) return "Enough: solving.";
  if (camera) return capital(camera.todo[0]);
  return run.busy_s > 0 ? `Recording: ${run.busy_s.toFixed(1)} s` : "Working.";
}

// How many views there are, and how well they know the focal length.
export function countWords({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
  const known = sigma === null ? "not known yet" : `± ${(100 * sigma).toFixed(2)} %`;
  return `${views} of ${wanted} views · focal length ${known}, wanted ± ${(100 * limit).toFixed(2)} %`;
}

// Share of the way: views count first, then the focal length.
export function progressOf({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
  return Math.min(1, views / wanted, sigma === null ? 0.5 : Math.max(0.5, limit / sigma));
}

function doneWords({ request, facts }) {
  if (request.kind !== "camera") return "Done. Restart the station to use the new calibration.";
  const [fx, fy, cx, cy] = facts.fx_fy_cx_cy_px;
  const sigma = facts.sigma_fx_fy_cx_cy_px;
  const one = (name, value, index) => `${name} ${value.toFixed(2)} ± ${sigma[index].toFixed(2)}`;
  return `Done from ${facts.num_views} views: ${one("fx", fx, 0)}, ${one("fy", fy, 1)}, ${one("cx", cx, 2)}, ${one("cy", cy, 3)} px; `
    + `residual ${facts.rms_px.toFixed(2)} px. Restart the station to use the new calibration.`;
}

export function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

export function polygon(points) {
  return points.map(([x, y]) => `${x},${y}`).join(" ");
}
