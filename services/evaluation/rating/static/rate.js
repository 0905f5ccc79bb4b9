// The rating page: plays a rollout, takes marks by mouse or keyboard, and asks for the next one.

import { actionOf, showKeys } from "./keys.js";
import { at, attempt, request } from "./request.js";

let rater = null;
let key = "";
let shown = null;
let pictures = [];
let marks = {};
let step = 0;
let playing = true;
let lastDraw = 0;

async function next() {
  const answer = await request(`next?rater=${encodeURIComponent(rater)}`, { key });
  if (answer.status === 204) {
    shown = null;
    at("rating").hidden = true;
    at("progress").textContent = "Everything is rated. Thank you.";
    return;
  }
  shown = await answer.json();
  marks = {};
  step = 0;
  playing = true;
  pictures = new Array(shown.num_steps).fill(null);
  at("progress").textContent = `${rater}: ${shown.num_done} rated, ${shown.num_open} to go`;
  at("instruction").textContent = shown.instruction;
  at("is_inconsistent").checked = false;
  at("comment").value = "";
  at("step").max = shown.num_steps - 1;
  listCriteria();
  at("rating").hidden = false;
  refresh();
  void load(shown);
}

async function load(rollout) {
  for (let index = 0; index < rollout.num_steps; index += 1) {
    if (shown !== rollout) return;
    try {
      const answer = await request(`rollouts/${rollout.rollout}/steps/${index}.jpg`, { key });
      pictures[index] = await createImageBitmap(await answer.blob());
    } catch (error) {
      if (shown === rollout) at("problem").textContent = `step ${index}: ${error.message}`;
      return;
    }
    if (index === step) draw();
  }
}

function listCriteria() {
  const rows = shown.criteria.map((criterion, index) => {
    const row = document.createElement("div");
    row.className = "criterion";
    const text = document.createElement("span");
    const hint = document.createElement("kbd");
    hint.dataset.action = `${index + 1}`;
    text.append(index < 9 ? hint : "", ` ${criterion.description}${criterion.latched ? "" : " (at the end)"}`);
    const choice = document.createElement("span");
    choice.className = "choice";
    for (const value of [true, false]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = value ? "Yes" : "No";
      button.dataset.criterion = criterion.name;
      button.dataset.value = `${value}`;
      button.addEventListener("click", () => set(criterion.name, value));
      choice.append(button);
    }
    row.append(text, choice);
    return row;
  });
  const legend = at("criteria").firstElementChild;
  at("criteria").replaceChildren(legend, ...rows);
  showKeys(rows.length);
}

function set(name, value) {
  marks[name] = value;
  refresh();
}

function refresh() {
  for (const button of document.querySelectorAll(".choice button")) {
    const chosen = `${marks[button.dataset.criterion]}` === button.dataset.value;
    button.setAttribute("aria-pressed", `${chosen}`);
  }
  at("save").disabled = shown.criteria.some(({ name }) => marks[name] === undefined);
  at("play").firstChild.textContent = playing ? "Pause " : "Play ";
}

function draw() {
  // An image may arrive after its rollout was left.
  if (!shown) return;
  const picture = pictures[step];
  at("step").value = step;
  at("time").textContent = `${(step / shown.rate_hz).toFixed(1)} s`;
  if (!picture) return;
  const canvas = at("picture");
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  canvas.getContext("2d").drawImage(picture, 0, 0);
}

function tick(now) {
  requestAnimationFrame(tick);
  if (!shown || !playing) return;
  if (now - lastDraw < 1000 / (shown.rate_hz * Number(at("speed").value))) return;
  lastDraw = now;
  const following = (step + 1) % shown.num_steps;
  if (pictures[following]) step = following;
  draw();
}

function move(to) {
  playing = false;
  step = Math.min(Math.max(to, 0), shown.num_steps - 1);
  draw();
  refresh();
}

async function save(cannotJudge) {
  const body = {
    rater,
    rollout: shown.rollout,
    presentation: shown.presentation,
    holds: cannotJudge ? {} : marks,
    is_inconsistent: !cannotJudge && at("is_inconsistent").checked,
    cannot_judge: cannotJudge,
    comment: at("comment").value,
  };
  await request("marks", { key, body });
  await next();
}

async function enter(name, secret) {
  [rater, key] = [name, secret];
  await next();
  at("enter").hidden = true;
}

// A link of an invitation ends in "#name:secret".
function enterByLink() {
  const [, name, secret] = /^#([a-z][a-z0-9_-]*):([\w-]+)$/.exec(location.hash) ?? [];
  at("enter").hidden = Boolean(name);
  if (name) void attempt(() => enter(name, secret));
}

addEventListener("hashchange", enterByLink);
at("enter").addEventListener("submit", (event) => {
  event.preventDefault();
  void attempt(() => enter(at("rater").value, at("key").value));
});
at("marks").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!at("save").disabled) void attempt(() => save(false));
});
at("cannot").addEventListener("click", () => void attempt(() => save(true)));
at("step").addEventListener("input", () => move(Number(at("step").value)));
at("play").addEventListener("click", () => {
  playing = !playing;
  refresh();
});
const BY_KEY = {
  play: () => at("play").click(),
  back: () => move(step - 1),
  forward: () => move(step + 1),
  inconsistent: () => at("is_inconsistent").click(),
  cannot: () => at("cannot").click(),
  save: () => at("save").click(),
  learned: () => {},
};
document.addEventListener("keydown", (event) => {
  const { tagName, type } = event.target;
  const isTyped = ["INPUT", "TEXTAREA", "SELECT"].includes(tagName) && type !== "checkbox" && type !== "range";
  if (!shown || isTyped || event.ctrlKey || event.metaKey || event.altKey) return;
  const action = actionOf(event);
  const criterion = shown.criteria[action - 1];
  if (!criterion && !BY_KEY[action]) return;
  event.preventDefault();
  // Held down, other keys than those of steps would answer for one rollout after another.
  if (event.repeat && action !== "back" && action !== "forward") return;
  if (criterion) set(criterion.name, !marks[criterion.name]);
  else BY_KEY[action]();
});
enterByLink();
requestAnimationFrame(tick);
