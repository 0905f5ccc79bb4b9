// The calibration page: what is due, and guided runs with live coverage of the board.

import { ageWords, capital, countWords, LEVELS, nextWords, polygon, progressOf, runLevel, runTitle } from "./calibration_words.js";
import { element, levelBadge, setText } from "./dom.js";
import { ask } from "./session.js";
import { startTheme } from "./theme.js";

const PERIOD_MS = 300;
const API = "/v1/alignment/calibration";
const SVG = "http://www.w3.org/2000/svg";
const ENDED = ["done", "failed", "cancelled"];
const find = (id) => document.getElementById(id);

let chosen = null;
let closed = sessionStorage.getItem("closed_run");
let shown = { run_id: "", state: "", image_index: -1 };

async function get(path) {
  const answer = await ask(`${API}${path}`);
  const data = await answer.json();
  if (!answer.ok) throw new Error(data.detail ?? `refused (${answer.status})`);
  return data;
}

async function post(path, body) {
  const answer = await ask(`${API}${path}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body ?? {}) });
  const data = await answer.json();
  if (!answer.ok) throw new Error(data.detail ?? `refused (${answer.status})`);
  return data;
}

function regions(item) {
  if (item.views_by_region.length === 0) return "–";
  const cells = item.views_by_region.flat().map((views) => element("span", { "data-enough": views >= 2 }, String(views)));
  return element("span", { class: "regions", title: "views of the board in each ninth of the image" }, ...cells);
}

function row(item) {
  const begin = item.run === null ? null : element("button", { type: "button" }, "Guided run");
  begin?.addEventListener("click", () => choose(item));
  const badge = levelBadge(LEVELS[item.state]);
  badge.textContent = item.state;
  return element("tr", { "data-name": item.name },
    element("td", {}, badge),
    element("td", { class: "name" }, item.title, element("span", { class: "why" }, item.name)),
    element("td", { class: "number" }, ageWords(item.age_days)),
    element("td", {}, item.sigma || "–"),
    element("td", { class: "free" }, item.residual || "–", item.meaning ? element("span", { class: "why" }, item.meaning) : null),
    element("td", {}, regions(item)),
    element("td", { class: "free step" }, element("span", {}, ...item.reasons.map((reason) => element("strong", { class: "why" }, reason)), item.step)),
    element("td", {}, begin));
}

async function showItems() {
  try {
    const overview = await get("");
    find("item_rows").replaceChildren(...overview.items.map(row));
    setText(find("folder"), overview.folder);
    setText(find("calibration_note"), overview.note);
  } catch (error) {
    setText(find("calibration_note"), error.message);
    find("calibration_note").dataset.level = "ERROR";
  }
}

function choose(item) {
  chosen = item;
  const isCamera = item.run.kind === "camera";
  setText(find("begin_title"), runTitle(item.run));
  setText(find("begin_step"), item.step);
  find("board").value = localStorage.getItem("board") ?? "charuco:5x7:30mm:22mm";
  for (const id of ["board_field", "board_help"]) find(id).hidden = !isCamera;
  find("begin").hidden = false;
  find("begin").scrollIntoView({ block: "nearest" });
  (isCamera ? find("board") : find("begin_form").querySelector("button")).focus();
}

async function begin(event) {
  event.preventDefault();
  const board = chosen.run.kind === "camera" ? find("board").value.trim() : "";
  if (board) localStorage.setItem("board", board);
  await act(async () => {
    const run = await post("/runs", { ...chosen.run, board });
    find("begin").hidden = true;
    showRun(run);
  });
}

async function act(action) {
  try {
    setText(find("run_message"), "");
    setText(find("calibration_note"), "");
    await action();
  } catch (error) {
    const place = find("run").hidden ? find("calibration_note") : find("run_message");
    place.dataset.level = "ERROR";
    setText(place, error.message);
  }
}

function shape(name, attributes) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, String(value));
  return node;
}

function showView(camera) {
  find("view").hidden = !camera;
  if (!camera || camera.image_index === shown.image_index) return;
  shown.image_index = camera.image_index;
  const { width_px: width, height_px: height } = camera;
  find("view_image").src = `${API}/run/image?at=${camera.image_index}`;
  const overlay = find("view_overlay");
  overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const kept = camera.outlines_px.map((points) => shape("polygon", { points: polygon(points), class: "kept" }));
  const lines = [1, 2].flatMap((n) => [
    shape("line", { x1: (n * width) / 3, x2: (n * width) / 3, y1: 0, y2: height }), shape("line", { x1: 0, x2: width, y1: (n * height) / 3, y2: (n * height) / 3 })]);
  const counts = camera.views_by_region.flatMap((views, y) => views.map((count, x) => {
    const text = shape("text", { "font-size": width / 22, x: ((x + 0.04) * width) / 3, y: ((y + 0.16) * height) / 3, "data-enough": count >= 2 });
    text.textContent = String(count);
    return text;
  }));
  const corners = camera.corners_px.map(([x, y]) => shape("circle", { cx: x, cy: y, r: width / 160, "data-kept": camera.hint === "" }));
  overlay.replaceChildren(...kept, ...lines, ...counts, ...corners);
}

function showRun(run) {
  const isEnded = ENDED.includes(run.state);
  find("run").hidden = run.run_id === closed && isEnded;
  if (find("run").hidden) return;
  setText(find("run_title"), runTitle(run.request));
  const state = find("run_state");
  state.dataset.level = runLevel(run.state);
  setText(state, run.state);
  setText(find("run_next"), nextWords(run));
  showView(run.camera);
  const { camera } = run;
  setText(find("run_hint"), hintOf(run, isEnded));
  find("run_count").hidden = !camera;
  if (camera) {
    find("run_progress").value = progressOf(camera);
    setText(find("run_count_text"), countWords(camera));
  }
  const todo = camera && !isEnded ? camera.todo.slice(1) : [];
  find("run_todo").replaceChildren(...todo.map((words) => element("li", {}, words)));
  const form = find("answer_form");
  const wasAsking = !form.hidden;
  form.hidden = run.state !== "asking";
  if (!form.hidden && (!wasAsking || form.dataset.question !== run.question)) {
    form.dataset.question = run.question;
    find("answer").value = "";
    find("answer").focus();
  }
  find("run_finish").hidden = isEnded || !camera || camera.num_views < 5;
  find("run_cancel").hidden = isEnded;
  find("run_close").hidden = !isEnded;
  find("run_lines").replaceChildren(...run.lines.map((line) => element("li", {}, line)));
  if (isEnded && shown.state !== run.state) showItems();
  shown = { ...shown, run_id: run.run_id, state: run.state };
}

function hintOf({ camera, lines }, isEnded) {
  if (isEnded) return "";
  if (!camera) return lines.at(-1) ?? "";
  return camera.hint ? capital(camera.hint) : "Kept: move the board to the next place.";
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

find("begin_form").addEventListener("submit", begin);
find("begin_back").addEventListener("click", () => { find("begin").hidden = true; });
find("answer_form").addEventListener("submit", (event) => {
  event.preventDefault();
  act(async () => showRun(await post("/run/answer", { text: find("answer").value })));
});
find("run_finish").addEventListener("click", () => act(async () => showRun(await post("/run/finish"))));
find("run_cancel").addEventListener("click", () => act(async () => showRun(await post("/run/cancel"))));
find("run_close").addEventListener("click", () => {
  closed = shown.run_id;
  sessionStorage.setItem("closed_run", closed);
  find("run").hidden = true;
});
startTheme(find("theme"), () => {});
await showItems();
poll();
