// Words and geometry of the calibration page, without DOM.

export const LEVELS = { good: "OK", due: "WARN", missing: "ERROR", optional: "STALE", simulated: "STALE" };
const RUN_LEVELS = { running: "WARN", asking: "WARN", done: "OK", failed: "ERROR", cancelled: "STALE" };

export function ageWords(days) {
  if (days === null || days === undefined) return "";
  if (days < 1 / 24) return `${Math.max(0, Math.round(days * 1440))} min`;
  return days < 2 ? `${Math.round(days * 24)} h` : `${Math.round(days)} days`;
}

export function runLevel(state) {
  return RUN_LEVELS[state] ?? "STALE";
}

export function runTitle({ kind, subject }) {
  const camera = `${subject.replaceAll("_", " ")} camera`;
  return { camera: `Lens of the ${camera}`, mount: `Mount of the ${camera}`, glove: `Glove ${subject}`, time: "Path delays" }[kind];
}

// What the operator has to do now, in one sentence.
export function nextWords(run, isPractised) {
  if (run.state === "asking") return run.question;
  if (run.state === "failed") return capital(run.problem);
  if (run.state === "cancelled") return cancelledWords(run);
  if (run.state === "done") return `${doneWords(run)}${isPractised ? "" : " Restart the station to use the new calibration."}`;
  const seen = run.camera ?? run.mount;
  if (isOfCamera(run) && !seen) return "Waiting for an image of the camera.";
  if (seen && seen.todo.length === 0) return "Enough: solving.";
  if (run.mount?.problem) return `These places do not fit: ${run.mount.problem}`;
  if (seen) return capital(seen.todo[0]);
  return run.countdown ? run.countdown.label : "Working.";
}

export function isOfCamera({ request }) {
  return request.kind === "camera" || request.kind === "mount";
}

function cancelledWords({ request, mount }) {
  const kept = mount?.places.length ?? 0;
  if (request.kind !== "mount" || kept === 0) return "Ended without a result; nothing was written.";
  return `Ended without a result; ${kept} ${kept > 1 ? "places are" : "place is"} kept: a new run can go on with them.`;
}

// What the newest image of a mount's run shows: words, and whether that is as it should be.
export function signsOf({ is_board_seen: board, is_tracked: tracked, is_still: still }) {
  return [
    [board ? "Board seen" : "Board not seen", board],
    [tracked ? "Tracker seen" : "Tracker not seen", tracked],
    [still ? "Still" : "Moving", still],
  ];
}

// Whole seconds that are left of what lasts for a known time.
export function secondsLeft({ duration_s: duration, elapsed_s: elapsed }) {
  return Math.max(0, Math.ceil(duration - elapsed - 0.05));
}

// Of a run of path delays: rows of streams, and of the pairs that they were found from.
export function delayRows({ streams, reference, pairs, loop_sigmas: loops, left_out: leftOut }) {
  const ms = (value, sigma) => `${value.toFixed(2)} ± ${sigma.toFixed(2)} ms`;
  return {
    streams: Object.entries(streams).map(([name, { latency_ms: value, sigma_ms: sigma }]) => [name, ms(value, sigma)]),
    pairs: pairs.map(({ a, b, offset_ms: value, sigma_ms: sigma }) => [`${a} – ${b}`, ms(value, sigma)]),
    leftOut: Object.entries(leftOut).map(([name, reason]) => `${name} ${reason}`),
    note: `Relative to ${reference}. Loops of three streams close within ${loops.toFixed(1)} standard deviations.`,
  };
}

// How many views there are, and how well they know the focal length.
export function countWords({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
  const known = sigma === null ? "not known yet" : `± ${(100 * sigma).toFixed(2)} %`;
  return `${views} of ${wanted} views · focal length ${known}, wanted ± ${(100 * limit).toFixed(2)} %`;
}

export function placesWords({ places }) {
  const leftOut = places.flatMap((counts, index) => (counts ? [] : [index + 1]));
  const words = `${places.length} ${places.length === 1 ? "place" : "places"} kept`;
  return leftOut.length === 0 ? words : `${words}, far off and left out: ${leftOut.join(", ")}`;
}

// Share of the way: views count first, then the focal length.
export function progressOf({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
  return Math.min(1, views / wanted, sigma === null ? 0.5 : Math.max(0.5, limit / sigma));
}

function doneWords({ request, facts }) {
  if (request.kind === "glove" || request.kind === "time") return "Done.";
  if (request.kind === "mount") {
    return `Done from ${facts.num_places} places: the mount is known to ± ${facts.sigma_rotation_deg.toFixed(2)}° and `
      + `± ${facts.sigma_translation_mm.toFixed(1)} mm; the board is ${facts.board_scale.toFixed(3)} times as large as entered.`;
  }
  const [fx, fy, cx, cy] = facts.fx_fy_cx_cy_px;
  const sigma = facts.sigma_fx_fy_cx_cy_px;
  const one = (name, value, index) => `${name} ${value.toFixed(2)} ± ${sigma[index].toFixed(2)}`;
  return `Done from ${facts.num_views} views: ${one("fx", fx, 0)}, ${one("fy", fy, 1)}, ${one("cx", cx, 2)}, ${one("cy", cy, 3)} px; `
    + `residual ${facts.rms_px.toFixed(2)} px.`;
}

export function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

export function polygon(points) {
  return points.map(([x, y]) => `${x},${y}`).join(" ");
}
