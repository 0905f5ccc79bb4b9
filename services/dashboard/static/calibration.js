// The calibration page: what is due, and guided runs with live coverage of the board.

import {
  ageWords, capital, countWords, delayRows, isOfCamera, LEVELS, nextWords, placesWords, polygon, progressOf, runLevel, runTitle, secondsLeft, signsOf,
} from "./calibration_words.js";
import * as api from "./catalog/api.js";
import { element, find, levelBadge, setText, showChildren, why } from "./dom.js";
import { keep, kept } from "./kept.js";
import { ask } from "./session.js";

const PERIOD_MS = 300;
const API = "/v1/alignment/calibration";
const SVG = "http://www.w3.org/2000/svg";
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
  const begin = item.run === null ? null : element("button", { type: "button" }, "Guided run");
  begin?.addEventListener("click", () => choose(item));
  return element("tr", { "data-name": item.name },
    element("td", {}, levelBadge(LEVELS[item.state], item.state)),
    element("td", { class: "name" }, item.title, why(item.name)),
    element("td", { class: "number" }, ageWords(item.age_days)),
    element("td", {}, item.sigma),
    element("td", { class: "free" }, item.residual, why(item.meaning)),
    element("td", {}, regions(item)),
    element("td", { class: "free step" }, element("span", {}, ...item.reasons.map((reason) => element("strong", { class: "why" }, reason)), item.step)),
    element("td", {}, begin));
}

async function showItems() {
  try {
    showOverview(await get(""));
  } catch (error) {
    setText(find("calibration_note"), error.message);
    find("calibration_note").dataset.level = "ERROR";
  }
}

function showOverview({ items, folder, note, is_simulated: isSimulated, practice }) {
  find("item_rows").replaceChildren(...items.map(row));
  setText(find("folder"), folder);
  setText(find("calibration_note"), note);
  find("calibration_note").dataset.level = "WARN";
  find("practice").hidden = !isSimulated;
  isPractised = practice === "on";
  setText(find("practice_title"), isPractised ? "Practice" : "Simulated devices");
  setText(find("practice_words"), PRACTICE_WORDS[practice] ?? "");
  find("practice_start").hidden = practice !== "off";
  find("practice_stop").hidden = !isPractised;
}

async function switchPractice(way, button) {
  const words = button.textContent;
  button.disabled = true;
  setText(button, way === "start" ? "Starting, about ten seconds …" : "Stopping …");
  await act(async () => {
    const overview = await post(`/practice/${way}`);
    find("begin").hidden = find("run").hidden = true;
    showOverview(overview);
  });
  button.disabled = false;
  setText(button, words);
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

async function begin(event) {
  event.preventDefault();
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
    const place = find(!find("run").hidden ? "run_message" : find("begin").hidden ? "calibration_note" : "begin_note");
    place.dataset.level = "ERROR";
    setText(place, error.message);
  }
}

function shape(name, attributes) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, String(value));
  return node;
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
  const kept = outlines.map((points) => shape("polygon", { points: polygon(points), class: "kept" }));
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
  showChildren(find("view_signs"), signsOf(mount).map(([words, isGood]) => element("li", { class: "level", "data-level": isGood ? "OK" : "WARN" }, words)));
  showChildren(find("gauges"), mount.gauges.map(gauge));
  find("run_drop").disabled = mount.places.length === 0;
}

function showResult(run) {
  const isShown = run.state === "done" && run.request.kind === "time";
  find("result").hidden = !isShown;
  if (!isShown || shown.state === "done") return;
  const { streams, pairs, leftOut, note } = delayRows(run.facts);
  const table = (title, rows) => element("table", {}, element("thead", {}, element("tr", {}, element("th", { scope: "col" }, title), element("th", { scope: "col" }, "Delay (± one sigma)"))),
    element("tbody", {}, ...rows.map(([name, words]) => element("tr", {}, element("td", { class: "name" }, name), element("td", {}, words)))));
  find("result").replaceChildren(table("Stream", streams), table("Pair, second after first", pairs), element("p", {}, note),
    element("ul", { class: "todo" }, ...leftOut.map((words) => element("li", {}, `Left out: ${words}`))));
}

function showCountdown(countdown) {
  find("run_countdown").hidden = !countdown;
  if (!countdown) return;
  find("countdown_bar").max = countdown.duration_s;
  find("countdown_bar").value = countdown.elapsed_s;
  find("countdown_bar").setAttribute("aria-label", countdown.label);
  setText(find("countdown_left"), `${secondsLeft(countdown)} s`);
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
  find("answer_choices").replaceChildren(...run.choices.map(({ label, answer }) => {
    const button = element("button", { type: "button" }, label);
    button.addEventListener("click", () => reply(answer));
    return button;
  }));
  find(run.takes_text ? "answer" : "answer_action").focus();
}

function showRun(run) {
  const isEnded = ENDED.includes(run.state);
  find("run").hidden = run.run_id === closed && isEnded;
  if (find("run").hidden) return;
  setText(find("run_title"), runTitle(run.request));
  const state = find("run_state");
  state.dataset.level = runLevel(run.state);
  setText(state, run.state);
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
    const answer = await ask(`${API}/run`);
    const run = answer.ok ? await answer.json() : null;
    if (run) showRun(run);
  } catch (error) {
    setText(find("run_message"), `The dashboard did not answer: ${error.message}`);
  }
  setTimeout(poll, ENDED.includes(shown.state) || shown.state === "" ? 4 * PERIOD_MS : PERIOD_MS);
}

function reply(text) {
  return act(async () => showRun(await post("/run/answer", { text })));
}

find("begin_form").addEventListener("submit", begin);
find("begin_back").addEventListener("click", () => { find("begin").hidden = true; });
find("answer_form").addEventListener("submit", (event) => {
  event.preventDefault();
  reply(find("answer").value);
});
for (const way of ["start", "stop"]) find(`practice_${way}`).addEventListener("click", ({ target }) => switchPractice(way, target));
for (const order of ["take", "drop", "finish", "cancel"]) find(`run_${order}`).addEventListener("click", () => act(async () => showRun(await post(`/run/${order}`))));
addEventListener("keydown", (event) => {
  const id = { t: "run_take", d: "run_drop" }[event.key.toLowerCase()];
  if (!id || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select") || find("run").hidden || find(id).hidden) return;
  event.preventDefault();
  find(id).click();
});
find("run_close").addEventListener("click", () => {
  closed = shown.run_id;
  keep("closed_run", closed, "sessionStorage");
  find("run").hidden = true;
});
await showItems();
poll();
