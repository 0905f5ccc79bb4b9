// Mark objects: the first images of a task's episodes one after the other, each click saved at once.

import { cleared } from "../canvas.js";
import { button, element, find, isModified, newestOnly, say, setText } from "../dom.js";
import { unpack } from "../packed.js";
import { ask, checked, get, pagePath, post } from "../requests.js";

const MAX_ZOOM = 40;
const DRAG_PX = 5;
// Corners of a box differ in one bit along each of its edges.
const EDGES = [1, 2, 4].flatMap((bit) => [...Array(8).keys()].filter((corner) => !(corner & bit)).map((corner) => [corner, corner | bit]));

// The image that is clicked in: zoom around the pointer, move by dragging, and the clicks with the boxes that they give.
class Stage {
  constructor(canvas, onClick) {
    Object.assign(this, { canvas, image: null, marks: [], zoom: 1, left: 0, top: 0, held: null });
    canvas.addEventListener("pointerdown", (event) => this.hold(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointercancel", () => { this.held = null; });
    canvas.addEventListener("pointerup", (event) => {
      const held = this.held;
      this.held = null;
      if (held && !held.moved && this.image) onClick(this.pixelAt(event));
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(event.deltaY < 0 ? 1.25 : 0.8, event);
    }, { passive: false });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(image) {
    this.image?.close();
    Object.assign(this, { image, zoom: 1, left: 0, top: 0 });
    if (image) this.canvas.closest(".marking").style.setProperty("--aspect", image.width / image.height);
    this.canvas.dataset.state = image ? "shown" : "loading";
    this.draw();
  }

  // Pixels of the page for one of the image.
  get scale() {
    return (this.zoom * this.canvas.clientWidth) / (this.image?.width ?? 1);
  }

  pixelAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const inside = (value, size) => Math.min(Math.max(value, 0), size);
    return [
      inside(this.left + (event.clientX - box.left) / this.scale, this.image.width),
      inside(this.top + (event.clientY - box.top) / this.scale, this.image.height),
    ];
  }

  hold(event) {
    if (event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.held = { x: event.clientX, y: event.clientY, left: this.left, top: this.top, moved: false };
  }

  drag(event) {
    if (!this.held || !this.image) return;
    const [dx, dy] = [event.clientX - this.held.x, event.clientY - this.held.y];
    if (Math.hypot(dx, dy) > DRAG_PX) this.held.moved = true;
    if (this.held.moved) this.moveTo(this.held.left - dx / this.scale, this.held.top - dy / this.scale);
  }

  moveTo(left, top) {
    const most = (size) => size * (1 - 1 / this.zoom);
    this.left = Math.min(Math.max(left, 0), most(this.image.width));
    this.top = Math.min(Math.max(top, 0), most(this.image.height));
    this.draw();
  }

  // Around a place of the page, by default the middle.
  zoomBy(factor, place) {
    if (!this.image) return;
    const box = this.canvas.getBoundingClientRect();
    const at = place ?? { clientX: box.left + box.width / 2, clientY: box.top + box.height / 2 };
    const [x, y] = this.pixelAt(at);
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), MAX_ZOOM);
    this.moveTo(x - (at.clientX - box.left) / this.scale, y - (at.clientY - box.top) / this.scale);
  }

  mark(marks) {
    this.marks = marks;
    this.draw();
  }

  draw() {
    // A finger scrolls the page over the whole image, and moves an enlarged one.
    this.canvas.style.touchAction = this.zoom > 1 ? "none" : "pan-y";
    const found = cleared(this.canvas);
    if (!found || !this.image) return;
    const { context, scale: ratio } = found;
    const scale = this.scale * ratio;
    context.imageSmoothingEnabled = scale < 3 * ratio;
    context.drawImage(this.image, -this.left * scale, -this.top * scale, this.image.width * scale, this.image.height * scale);
    const place = ([u, v]) => [(u - this.left) * scale, (v - this.top) * scale];
    for (const mark of this.marks) drawMark(context, mark, place, ratio);
  }
}

// Lines have a dark rim, so that they show on any image.
function stroke(context, path, colour, ratio) {
  for (const [style, width] of [["rgb(0 0 0 / 65%)", 3.5], [colour, 1.5]]) {
    Object.assign(context, { strokeStyle: style, lineWidth: width * ratio });
    context.stroke(path);
  }
}

function drawMark(context, { label, point_px, heading_px, box_px, colour }, place, ratio) {
  if (box_px) {
    const box = new Path2D();
    for (const [from, to] of EDGES) {
      box.moveTo(...place(box_px[from]));
      box.lineTo(...place(box_px[to]));
    }
    context.globalAlpha = 0.7;
    stroke(context, box, colour, ratio);
    context.globalAlpha = 1;
  }
  if (!point_px) return;
  const [x, y] = place(point_px);
  const cross = new Path2D();
  const arm = 9 * ratio;
  for (const [dx, dy] of [[1, 0], [0, 1]]) for (const sign of [-1, 1]) {
    cross.moveTo(x + sign * dx * 3 * ratio, y + sign * dy * 3 * ratio);
    cross.lineTo(x + sign * dx * arm, y + sign * dy * arm);
  }
  if (heading_px) {
    const [ahead_x, ahead_y] = place(heading_px);
    cross.moveTo(x, y);
    cross.lineTo(ahead_x, ahead_y);
    cross.moveTo(ahead_x + 4 * ratio, ahead_y);
    cross.arc(ahead_x, ahead_y, 4 * ratio, 0, 2 * Math.PI);
  }
  stroke(context, cross, colour, ratio);
  context.font = `600 ${13 * ratio}px system-ui, sans-serif`;
  Object.assign(context, { lineWidth: 3 * ratio, strokeStyle: "rgb(0 0 0 / 75%)", fillStyle: colour });
  context.strokeText(label, x + 10 * ratio, y - 10 * ratio);
  context.fillText(label, x + 10 * ratio, y - 10 * ratio);
}

// What is said of an object: "open", "heading" (the first click is there, the second not), or "done".
function stateOf(object, click) {
  if (!click) return "open";
  const needs = click.state === "seen" && !object.click?.symmetric && !click.heading_px;
  return needs ? "heading" : "done";
}

function isDone(objects, clicks) {
  return objects.every((object) => stateOf(object, clicks[object.name]) === "done");
}

// The object after this one that has something left to click; the same if none has.
function nextOpen(objects, clicks, active) {
  const order = [...objects.keys()].map((step) => (active + step) % objects.length);
  return order.find((index) => stateOf(objects[index], clicks[objects[index].name]) !== "done") ?? active;
}

// Clicks with one more on an object: its point, its heading, or a new point in place of both.
function withClick(object, clicks, pixel) {
  const old = clicks[object.name];
  const click = stateOf(object, old) === "heading" ? { ...old, heading_px: pixel } : { state: "seen", point_px: pixel };
  return { ...clicks, [object.name]: click };
}

function withState(object, clicks, state) {
  return { ...clicks, [object.name]: { state } };
}

// The next episode that is not done, after the current one and around; the one after it if all are.
function nextEpisode(objects, episodes, current) {
  const order = episodes.map((_, step) => (current + 1 + step) % episodes.length);
  const open = (index) => !isDone(objects, episodes[index].clicks?.objects ?? {});
  return order.find((index) => index !== current && open(index)) ?? order[0] ?? 0;
}

function counts(objects, episodes) {
  return { done: episodes.filter((one) => one.clicks && isDone(objects, one.clicks.objects)).length, all: episodes.length };
}

const STORE = "/v1/episode_store";
const ACTIVE = "#ffd24a";
const OTHER = "#7ddba6";
const task = find("task");
const state = { objects: [], episodes: [], current: 0, active: 0, history: [] };
let saving = Promise.resolve();
let pending = 0;

const stage = new Stage(find("image"), (pixel) => change((object, clicks) => withClick(object, clicks, pixel)));
const episode = () => state.episodes[state.current];
const clicksOf = (one) => one?.clicks?.objects ?? {};

// What is shown

const WORDS = {
  open: (object) => `click ${object.click?.point_m ? "its point" : "the middle of its top"}`,
  heading: (object) => `click farther along its ${object.click?.heading ?? "x"} axis`,
  done: (_, click) => ({ seen: "clicked", absent: "not there", hidden: "cannot be seen" })[click.state],
};

function objectRow(object, index) {
  const click = clicksOf(episode())[object.name];
  const now = stateOf(object, click);
  const words = [element("span", { class: "digit" }, index + 1), element("span", { class: "name" }, object.name), element("span", { class: "quiet" }, WORDS[now](object, click))];
  return button(words, () => choose(index), { "data-key": object.name, "data-state": now, "aria-pressed": index === state.active });
}

function show() {
  const one = episode();
  const { done, all } = counts(state.objects, state.episodes);
  setText(find("progress"), all ? `${done} of ${all} marked` : "");
  find("bar").max = Math.max(all, 1);
  find("bar").value = done;
  setText(find("episode"), one ? `${state.current + 1}: ${one.episode_id}` : "");
  find("player").href = one ? pagePath(`/episodes/episode/${encodeURIComponent(one.episode_id)}`) : "";
  for (const id of ["player", "tools", "objects"]) find(id).hidden = !one;
  find("undo").disabled = !state.history.length;
  find("objects").replaceChildren(...(one ? state.objects.map(objectRow) : []));
  stage.mark(state.objects.map((object, index) => ({
    ...clicksOf(one)[object.name], label: String(index + 1), box_px: one?.boxes?.[object.name], colour: index === state.active ? ACTIVE : OTHER,
  })));
}

function choose(index) {
  if (!state.objects[index]) return;
  state.active = index;
  show();
}

// Changes are shown at once and saved one after the other; what the store refuses is taken back.

function change(changed) {
  const object = state.objects[state.active];
  if (!object || !stage.image) return;
  const before = clicksOf(episode());
  const after = changed(object, before);
  state.history.push(before);
  if (stateOf(object, after[object.name]) === "done") state.active = nextOpen(state.objects, after, state.active);
  save(after);
}

function undo() {
  const before = stage.image ? state.history.pop() : null;
  if (!before) return;
  const now = clicksOf(episode());
  state.active = Math.max(state.objects.findIndex(({ name }) => before[name] !== now[name]), 0);
  save(before);
}

function save(objects) {
  const one = episode();
  one.clicks = { objects };
  pending += 1;
  say(find("message"), "Saving …");
  show();
  saving = saving.then(async () => {
    try {
      const kept = await post(`${STORE}/episodes/${encodeURIComponent(one.episode_id)}/clicks`, { objects });
      Object.assign(one, { kept: objects, boxes: kept.boxes_px });
      if (pending === 1) say(find("message"), isDone(state.objects, objects) ? "Saved. Enter goes on." : "Saved.", "OK");
    } catch (error) {
      one.clicks = { objects: one.kept };
      if (one === episode()) Object.assign(state, { history: [], active: nextOpen(state.objects, one.kept, 0) });
      say(find("message"), error.message, "ERROR");
    }
    pending -= 1;
    show();
  });
}

async function go(index) {
  Object.assign(state, { current: index, history: [] });
  const one = episode();
  stage.show(null);
  say(find("message"), "");
  state.active = one ? nextOpen(state.objects, clicksOf(one), 0) : 0;
  show();
  await load(one);
}

const load = newestOnly(async (one) => {
  if (!one) return null;
  await saving;
  const id = encodeURIComponent(one.episode_id);
  const about = await get(`${STORE}/episodes/${id}/clicks`);
  const span = `start_ns=${about.image_t_ns}&stop_ns=${about.image_t_ns + 1}`;
  const answer = await checked(await ask(`${STORE}/playback/episode/${id}/images/camera_head?${span}`));
  const { arrays } = unpack(await answer.arrayBuffer());
  return { one, about, image: await createImageBitmap(new Blob([arrays.data.values], { type: "image/jpeg" }), { imageOrientation: "none" }) };
}, (found) => {
  if (!found) return;
  const { one, about, image } = found;
  Object.assign(one, { clicks: about.clicks, kept: about.clicks.objects, boxes: about.boxes_px });
  state.active = nextOpen(state.objects, clicksOf(one), 0);
  stage.show(image);
  if (about.problem) say(find("message"), about.problem, "ERROR");
  show();
}, (error) => say(find("message"), error.message, "ERROR"));

async function open(name) {
  const query = new URLSearchParams({ limit: find("limit").value, ...(name && { task: name }) });
  try {
    const queue = await get(`${STORE}/catalog/clicks?${query}`);
    task.replaceChildren(...queue.tasks.map((value) => element("option", { value }, value)));
    task.value = queue.task;
    Object.assign(state, { objects: queue.objects, episodes: queue.episodes });
    const more = queue.num_matching - queue.episodes.length;
    setText(find("more"), more > 0 ? `${more} more could be marked; 10 to 30 are enough to begin with.` : "");
    find("empty").hidden = queue.episodes.length > 0;
    setText(find("list_error"), "");
  } catch (error) {
    setText(find("list_error"), error.message);
    Object.assign(state, { objects: [], episodes: [] });
  }
  const first = state.episodes.findIndex((one) => !isDone(state.objects, clicksOf(one)));
  await go(Math.max(first, 0));
}

function reopen() {
  history.replaceState(null, "", pagePath(`${location.pathname}?${new URLSearchParams({ task: task.value, limit: find("limit").value })}`));
  open(task.value);
}

// Keys and buttons

const ACTIONS = {
  next: () => go(nextEpisode(state.objects, state.episodes, state.current)),
  previous: () => state.episodes.length && go((state.current + state.episodes.length - 1) % state.episodes.length),
  undo,
  absent: () => change((object, clicks) => withState(object, clicks, "absent")),
  hidden: () => change((object, clicks) => withState(object, clicks, "hidden")),
  zoom_in: () => stage.zoomBy(1.5),
  zoom_out: () => stage.zoomBy(1 / 1.5),
  whole: () => stage.zoomBy(0),
};
const KEYS = { Enter: "next", Backspace: "undo", a: "absent", h: "hidden", "+": "zoom_in", "-": "zoom_out", 0: "whole" };

for (const [name, act] of Object.entries(ACTIONS)) {
  find(name).addEventListener("click", ({ detail, currentTarget }) => {
    // After a click of the mouse, Enter goes on; after a key it presses the button again.
    if (detail) currentTarget.blur();
    act();
  });
}
document.addEventListener("keydown", (event) => {
  const isOfButton = event.target.matches("button") && ["Enter", " "].includes(event.key);
  if (isOfButton || event.target.matches("input, select, a") || isModified(event)) return;
  const name = event.key === "Enter" && event.shiftKey ? "previous" : KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  const digit = Number(event.key);
  if (!name && !(digit >= 1)) return;
  event.preventDefault();
  if (name) ACTIONS[name]();
  else choose(digit - 1);
});
task.addEventListener("change", reopen);
find("limit").addEventListener("change", reopen);
// A click that is still on its way is not lost.
window.addEventListener("beforeunload", (event) => { if (pending) event.preventDefault(); });

const given = new URLSearchParams(location.search);
if (given.get("limit")) find("limit").value = given.get("limit");
await open(given.get("task") ?? "");
