// The calibration page: what is due, and guided runs with live coverage of the board.

import { attempt, button, cell, element, find, isModified, keep, kept, levelBadge, onClick, onSubmit, say, setText, shape, showChildren, table, why } from "./dom.js";
import * as api from "./requests.js";

const LEVELS = { good: "OK", due: "WARN", missing: "ERROR", optional: "STALE", simulated: "STALE" };
const RUN_LEVELS = { running: "WARN", asking: "WARN", done: "OK", failed: "ERROR", cancelled: "STALE" };

function ageWords(days) {
  if (days === null || days === undefined) return "";
  if (days < 1 / 24) return `${Math.max(0, Math.round(days * 1440))} min`;
  return days < 2 ? `${Math.round(days * 24)} h` : `${Math.round(days)} days`;
}

function runTitle({ kind, subject }) {
  const camera = `${subject.replaceAll("_", " ")} camera`;
  return { camera: `Lens of the ${camera}`, mount: `Mount of the ${camera}`, glove: `Glove ${subject}`, time: "Path delays" }[kind];
}

// What the operator has to do now, in one sentence.
function nextWords(run, isPractised) {
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

function isOfCamera({ request }) {
  return request.kind === "camera" || request.kind === "mount";
}

function cancelledWords({ request, mount }) {
  const kept = mount?.places.length ?? 0;
  if (request.kind !== "mount" || kept === 0) return "Ended without a result; nothing was written.";
  return `Ended without a result; ${kept} ${kept > 1 ? "places are" : "place is"} kept: a new run can go on with them.`;
}

// How many views there are, and how well they know the focal length.
function countWords({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
  const known = sigma === null ? "not known yet" : `± ${(100 * sigma).toFixed(2)} %`;
  return `${views} of ${wanted} views · focal length ${known}, wanted ± ${(100 * limit).toFixed(2)} %`;
}

function placesWords({ places }) {
  const leftOut = places.flatMap((counts, index) => (counts ? [] : [index + 1]));
  const words = `${places.length} ${places.length === 1 ? "place" : "places"} kept`;
  return leftOut.length === 0 ? words : `${words}, far off and left out: ${leftOut.join(", ")}`;
}

// Share of the way: views count first, then the focal length.
function progressOf({ num_views: views, num_wanted: wanted, focal_sigma: sigma, focal_sigma_wanted: limit }) {
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

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

const PERIOD_MS = 300;
const API = "/v1/alignment/calibration";
const ENDED = ["done", "failed", "cancelled"];

let chosen = null;
let isPractised = false;
let closed = kept("closed_run", "sessionStorage");
let shown = { run_id: "", state: "", image_index: -1 };
const PRACTICE_WORDS = {
  off: "Nothing has to be calibrated. To practise, start simulated devices: a board moves before the head camera, trackers move with it, gloves lie untouched.",
  on: "You practise with simulated devices; their calibration is kept apart from that of real ones. The board is chessboard:9x6:25mm.",
};

const get = (path) => api.get(`${API}${path}`);
const post = (path, body = {}) => api.post(`${API}${path}`, body);

function regions(item) {
  if (item.views_by_region.length === 0) return "";
  const cells = item.views_by_region.flat().map((views) => element("span", { "data-enough": views >= 2 }, String(views)));
  return element("span", { class: "regions", title: "views of the board in each ninth of the image" }, ...cells);
}

function row(item) {
  const steps = element("span", {}, ...item.reasons.map((reason) => element("strong", { class: "why" }, reason)), item.step);
  return element("tr", { "data-name": item.name }, cell(levelBadge(LEVELS[item.state], item.state)), cell([item.title, why(item.name)], "name"),
    cell(ageWords(item.age_days), "number"), cell(item.sigma), cell([item.residual, why(item.meaning)], "free"), cell(regions(item)),
    cell(steps, "free step"), cell(item.run && button("Guided run", () => choose(item))));
}

function showItems() {
  return attempt(find("calibration_note"), async () => showOverview(await get("")));
}

function showOverview({ items, folder, note, is_simulated: isSimulated, practice }) {
  find("item_rows").replaceChildren(...items.map(row));
  setText(find("folder"), folder);
  say(find("calibration_note"), note, "WARN");
  find("practice").hidden = !isSimulated;
  isPractised = practice === "on";
  setText(find("practice_title"), isPractised ? "Practice" : "Simulated devices");
  setText(find("practice_words"), PRACTICE_WORDS[practice] ?? "");
  find("practice_start").hidden = practice !== "off";
  find("practice_stop").hidden = !isPractised;
}

async function switchPractice(way, { target }) {
  const words = target.textContent;
  target.disabled = true;
  setText(target, way === "start" ? "Starting, about ten seconds …" : "Stopping …");
  await act(async () => {
    const overview = await post(`/practice/${way}`);
    find("begin").hidden = find("run").hidden = true;
    showOverview(overview);
  });
  target.disabled = false;
  setText(target, words);
  find(way === "start" ? "practice_stop" : "practice_start").focus();
}

function choose(item) {
  chosen = item;
  const hasBoard = isOfCamera({ request: item.run });
  setText(find("begin_title"), runTitle(item.run));
  setText(find("begin_step"), item.step);
  setText(find("begin_note"), "");
  find("board").value = isPractised ? "chessboard:9x6:25mm" : kept("board") ?? "charuco:5x7:30mm:22mm";
  for (const id of ["board_field", "board_help"]) find(id).hidden = !hasBoard;
  const numKept = item.num_kept_places;
  find("resume_field").hidden = numKept === 0;
  find("resume").checked = true;
  setText(find("resume_words"), `Go on with the ${numKept} ${numKept > 1 ? "places" : "place"} of the run that was ended`);
  find("begin").hidden = false;
  find("begin").scrollIntoView({ block: "nearest" });
  (hasBoard ? find("board") : find("begin_form").querySelector("button")).focus();
}

async function begin() {
  const board = isOfCamera({ request: chosen.run }) ? find("board").value.trim() : "";
  if (board && !isPractised) keep("board", board);
  const isResumed = chosen.num_kept_places > 0 && find("resume").checked;
  await act(async () => {
    const run = await post("/runs", { ...chosen.run, board, is_resumed: isResumed });
    find("begin").hidden = true;
    showRun(run);
    find("run").scrollIntoView({ block: "start" });
  });
}

async function act(action) {
  try {
    for (const id of ["run_message", "begin_note", "calibration_note"]) setText(find(id), "");
    await action();
  } catch (error) {
    say(find(!find("run").hidden ? "run_message" : find("begin").hidden ? "calibration_note" : "begin_note"), error.message, "ERROR");
  }
}

function showView(seen) {
  find("view").hidden = !seen;
  if (!seen || seen.image_index === shown.image_index) return;
  shown.image_index = seen.image_index;
  const { width_px: width, height_px: height } = seen;
  find("view_image").src = `${API}/run/image?at=${seen.image_index}`;
  const overlay = find("view_overlay");
  overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const corners = seen.corners_px.map(([x, y]) => shape("circle", { cx: x, cy: y, r: width / 160, "data-kept": seen.hint === "" }));
  overlay.replaceChildren(...(seen.views_by_region ? coverage(seen) : []), ...corners);
}

function coverage({ width_px: width, height_px: height, outlines_px: outlines, views_by_region: regions_ }) {
  const kept = outlines.map((points) => shape("polygon", { points: points.join(" "), class: "kept" }));
  const lines = [1, 2].flatMap((n) => [
    shape("line", { x1: (n * width) / 3, x2: (n * width) / 3, y1: 0, y2: height }), shape("line", { x1: 0, x2: width, y1: (n * height) / 3, y2: (n * height) / 3 })]);
  const counts = regions_.flatMap((views, y) => views.map((count, x) => {
    const text = shape("text", { "font-size": width / 22, x: ((x + 0.04) * width) / 3, y: ((y + 0.16) * height) / 3, "data-enough": count >= 2 });
    text.textContent = String(count);
    return text;
  }));
  return [...kept, ...lines, ...counts];
}

function gauge({ title, value, wanted, share }) {
  return element("li", { "data-full": share >= 1 },
    element("span", { class: "gauge_title" }, title), element("meter", { min: 0, max: 1, value: share, "aria-label": title }),
    element("span", { class: "gauge_value" }, value, element("span", { class: "quiet" }, `, wanted ${wanted}`)));
}

function showMount(mount, isOn) {
  find("view_signs").hidden = find("gauges").hidden = !mount;
  find("run_take").hidden = find("run_drop").hidden = !mount || !isOn;
  if (!mount) return;
  find("view_signs").hidden = !isOn;
  const signs = [[mount.is_board_seen, "Board seen", "Board not seen"], [mount.is_tracked, "Tracker seen", "Tracker not seen"], [mount.is_still, "Still", "Moving"]];
  showChildren(find("view_signs"), signs.map(([isGood, good, bad]) => element("li", { class: "level", "data-level": isGood ? "OK" : "WARN" }, isGood ? good : bad)));
  showChildren(find("gauges"), mount.gauges.map(gauge));
  find("run_drop").disabled = mount.places.length === 0;
}

function showResult(run) {
  const isShown = run.state === "done" && run.request.kind === "time";
  find("result").hidden = !isShown;
  if (!isShown || shown.state === "done") return;
  const { streams, reference, pairs, loop_sigmas: loops, left_out: leftOut } = run.facts;
  const delays = (title, rows) => table([title, "Delay (± one sigma)"], rows.map(([name, delay, sigma]) => [name, `${delay.toFixed(2)} ± ${sigma.toFixed(2)} ms`]));
  find("result").replaceChildren(delays("Stream", Object.entries(streams).map(([name, { latency_ms, sigma_ms }]) => [name, latency_ms, sigma_ms])),
    delays("Pair, second after first", pairs.map(({ a, b, offset_ms, sigma_ms }) => [`${a} – ${b}`, offset_ms, sigma_ms])),
    element("p", {}, `Relative to ${reference}. Loops of three streams close within ${loops.toFixed(1)} standard deviations.`),
    element("ul", { class: "todo" }, ...Object.entries(leftOut).map(([name, reason]) => element("li", {}, `Left out: ${name} ${reason}`))));
}

function showCountdown(countdown) {
  find("run_countdown").hidden = !countdown;
  if (!countdown) return;
  find("countdown_bar").max = countdown.duration_s;
  find("countdown_bar").value = countdown.elapsed_s;
  find("countdown_bar").setAttribute("aria-label", countdown.label);
  setText(find("countdown_left"), `${Math.max(0, Math.ceil(countdown.duration_s - countdown.elapsed_s - 0.05))} s`);
}

function showQuestion(run) {
  const form = find("answer_form");
  const wasAsking = !form.hidden;
  form.hidden = run.state !== "asking";
  if (form.hidden || (wasAsking && form.dataset.question === run.question)) return;
  form.dataset.question = run.question;
  find("answer").value = "";
  find("answer_field").hidden = !run.takes_text;
  setText(find("answer_action"), run.action);
  find("answer_choices").replaceChildren(...run.choices.map(({ label, answer }) => button(label, () => reply(answer))));
  find(run.takes_text ? "answer" : "answer_action").focus();
}

function showRun(run) {
  const isEnded = ENDED.includes(run.state);
  find("run").hidden = run.run_id === closed && isEnded;
  if (find("run").hidden) return;
  setText(find("run_title"), runTitle(run.request));
  say(find("run_state"), run.state, RUN_LEVELS[run.state] ?? "STALE");
  setText(find("run_next"), nextWords(run, isPractised));
  const { camera, mount } = run;
  const seen = camera ?? mount;
  showView(seen);
  showMount(mount, run.state === "running");
  showResult(run);
  showCountdown(run.countdown);
  setText(find("run_hint"), hintOf(run, isEnded));
  find("run_count").hidden = !seen;
  if (camera) {
    find("run_progress").value = progressOf(camera);
    setText(find("run_count_text"), countWords(camera));
  } else if (mount) {
    find("run_progress").value = Math.min(...mount.gauges.map(({ share }) => share));
    setText(find("run_count_text"), placesWords(mount));
  }
  const todo = seen && !isEnded ? seen.todo.slice(1) : [];
  showChildren(find("run_todo"), todo.map((words) => element("li", {}, words)));
  showQuestion(run);
  find("run_finish").hidden = isEnded || !seen || !(camera ? camera.num_views >= 5 : mount.can_finish);
  setText(find("run_finish"), mount ? "Write the mount now" : "Calibrate now");
  find("run_cancel").hidden = isEnded;
  setText(find("run_cancel"), mount?.places.length ? "Pause: keep the places" : "End without result");
  find("run_close").hidden = !isEnded;
  find("run_lines").replaceChildren(...run.lines.map((line) => element("li", {}, line)));
  if (isEnded && shown.state !== run.state) showItems();
  shown = { ...shown, run_id: run.run_id, state: run.state };
}

function hintOf({ camera, mount, lines, countdown }, isEnded) {
  if (isEnded || countdown) return "";
  const seen = camera ?? mount;
  if (!seen) return lines.at(-1) ?? "";
  return seen.hint ? capital(seen.hint) : `Kept: move the ${camera ? "board" : "camera"} to the next place.`;
}

async function poll() {
  try {
    const answer = await api.ask(`${API}/run`);
    const run = answer.ok ? await answer.json() : null;
    if (run) showRun(run);
  } catch (error) {
    setText(find("run_message"), error.message);
  }
  setTimeout(poll, ENDED.includes(shown.state) || shown.state === "" ? 4 * PERIOD_MS : PERIOD_MS);
}

function reply(text) {
  return act(async () => showRun(await post("/run/answer", { text })));
}

function order(name) {
  return act(async () => showRun(await post(`/run/${name}`)));
}

function close() {
  closed = shown.run_id;
  keep("closed_run", closed, "sessionStorage");
  find("run").hidden = true;
}

onSubmit(find("begin_form"), begin);
onSubmit(find("answer_form"), () => reply(find("answer").value));
onClick({
  begin_back: () => { find("begin").hidden = true; }, run_close: close,
  practice_start: (event) => switchPractice("start", event), practice_stop: (event) => switchPractice("stop", event),
  run_take: () => order("take"), run_drop: () => order("drop"), run_finish: () => order("finish"), run_cancel: () => order("cancel"),
});
addEventListener("keydown", (event) => {
  const id = { t: "run_take", d: "run_drop" }[event.key.toLowerCase()];
  if (!id || isModified(event) || event.target.matches("input, select") || find("run").hidden || find(id).hidden) return;
  event.preventDefault();
  find(id).click();
});
await showItems();
poll();
