// Hands and poses in space, drawn on a 2-D canvas; drag or arrow keys turn, wheel or + and - zoom, double click or 0 resets.

import { beforeNextFrame, cleared, css } from "./canvas.js";
import { element, levelBadge, showChildren } from "./dom.js";
import { age } from "./format.js";
import { apply, fitted, orbitCamera, project, turned, zoomed } from "./projection.js";
import { scene } from "./poses.js";

const HOME = { target_m: [0, 0, 1], distance_m: 1.5, azimuth_rad: -1.9, elevation_rad: 0.35 };
const LIST_PERIOD_MS = 250;
const AXIS_M = 0.05;
const GRID_M = 0.1;
const GRID_CELLS = 5;
const KEYS = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, 12], ArrowDown: [0, -12] };
const ZOOMS = { "+": 0.9, "-": 1 / 0.9 };

export class PoseView {
  constructor(canvas, list, bones) {
    this.canvas = canvas;
    this.list = list;
    this.bones = bones;
    this.streams = [];
    this.note = "waiting for poses";
    this.orbit = HOME;
    this.fits = false;
    this.floor_m = 0;
    this.request = beforeNextFrame(() => this.draw());
    this.listed = { text: "", at_ms: 0 };
    this.listen();
    new ResizeObserver(() => this.request()).observe(canvas);
  }

  listen() {
    const pointers = new Map();
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const [other] = [...pointers.values()].filter((pointer) => pointer.pointerId !== event.pointerId);
      const gap_px = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (other) this.move(zoomed(this.orbit, gap_px(before) / Math.max(1, gap_px(event))));
      else this.move(turned(this.orbit, event.clientX - before.clientX, event.clientY - before.clientY));
      pointers.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.move(zoomed(this.orbit, Math.exp(0.0012 * event.deltaY)));
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => this.reset());
    this.canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key in KEYS) this.move(turned(this.orbit, ...KEYS[event.key]));
      else if (event.key in ZOOMS) this.move(zoomed(this.orbit, ZOOMS[event.key]));
      else if (event.key === "0") this.reset();
      else return;
      event.preventDefault();
    });
  }

  move(orbit) {
    this.orbit = orbit;
    this.request();
  }

  reset() {
    this.orbit = HOME;
    this.fits = false;
    this.request();
  }

  update(streams) {
    this.streams = streams;
    this.note = streams.length === 0 ? "This station has no trackers." : "";
    this.showList();
    this.request();
  }

  clear(reason) {
    this.update(this.streams.map((stream) => ({ ...stream, age_s: null, values: new Float32Array(0) })));
    this.note = reason;
  }

  // Age and state of each stream: four times a second, and at once when a state changes.
  showList() {
    const text = this.streams.map(({ name, values }) => `${name} ${values.length > 0}`).join();
    const now_ms = performance.now();
    if (text === this.listed.text && now_ms - this.listed.at_ms < LIST_PERIOD_MS) return;
    this.listed = { text, at_ms: now_ms };
    showChildren(this.list, this.streams.map(({ name, age_s, values }) => element("li", { "data-stream": name },
      levelBadge(values.length > 0 ? "OK" : "STALE"),
      element("span", {}, name.replaceAll("_", " ")),
      element("span", { class: "quiet" }, age_s === null ? "no data" : age(age_s)))));
  }

  draw() {
    const found = cleared(this.canvas);
    if (!found) return;
    const { context, scale } = found;
    const size = { width_px: this.canvas.clientWidth, height_px: this.canvas.clientHeight };
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    context.lineCap = context.lineJoin = "round";
    const { bodies, hands } = scene(this.streams);
    this.fit(bodies, hands);
    const T_camera_world = orbitCamera(this.orbit);
    const pen = new Pen(context, (point) => project(T_camera_world, point, size));
    this.drawGrid(pen);
    for (const body of bodies) this.drawBody(pen, body);
    for (const hand of hands) this.drawHand(pen, hand);
    if (this.note) pen.note(this.note, size);
  }

  // The first poses, and those after a reset, choose what the picture shows; later ones move in it.
  fit(bodies, hands) {
    const origins = bodies.map(({ T_world_body: T }) => [T[3], T[7], T[11]]);
    const all = [...origins, ...hands.flatMap((hand) => hand.points_world)];
    if (this.fits || all.length === 0) return;
    this.orbit = fitted(this.orbit, all);
    this.floor_m = GRID_M * Math.floor(Math.min(...all.map((point) => point[2]).filter(Number.isFinite)) / GRID_M);
    this.fits = true;
  }

  drawGrid(pen) {
    const [x_m, y_m] = this.orbit.target_m.map((value) => GRID_M * Math.round(value / GRID_M));
    const reach_m = GRID_M * GRID_CELLS;
    pen.style(css("--line"), 1);
    for (let cell = -GRID_CELLS; cell <= GRID_CELLS; cell += 1) {
      const offset_m = cell * GRID_M;
      pen.line([x_m - reach_m, y_m + offset_m, this.floor_m], [x_m + reach_m, y_m + offset_m, this.floor_m]);
      pen.line([x_m + offset_m, y_m - reach_m, this.floor_m], [x_m + offset_m, y_m + reach_m, this.floor_m]);
    }
  }

  drawBody(pen, { name, T_world_body: T }) {
    const origin = [T[3], T[7], T[11]];
    pen.style(css("--line"), 1.5);
    pen.line(origin, [origin[0], origin[1], this.floor_m]);
    [[AXIS_M, 0, 0], [0, AXIS_M, 0], [0, 0, AXIS_M]].forEach((tip, axis) => {
      pen.style(css(`--axis_${"xyz"[axis]}`), 2.5);
      pen.line(origin, apply(T, tip));
    });
    pen.label(name.replaceAll("_", " "), origin, css("--quiet"));
  }

  drawHand(pen, { side, placed, points_world }) {
    const colour = css(`--hand_${side}`);
    pen.style(colour, 3, placed ? [] : [5, 5]);
    for (const [parent, node] of this.bones) pen.line(points_world[parent], points_world[node]);
    pen.style(colour, 1);
    points_world.forEach((point) => pen.dot(point, colour, 2.6));
    if (!placed) pen.label(`${side} hand, wrist not tracked`, points_world[0], colour);
  }
}

class Pen {
  constructor(context, toPixel) {
    this.context = context;
    this.toPixel = toPixel;
  }

  style(colour, width_px, dashes_px = []) {
    this.context.strokeStyle = colour;
    this.context.lineWidth = width_px;
    this.context.setLineDash(dashes_px);
  }

  line(from, to) {
    const [start, stop] = [this.toPixel(from), this.toPixel(to)];
    if (!start || !stop) return;
    this.context.beginPath();
    this.context.moveTo(start.x_px, start.y_px);
    this.context.lineTo(stop.x_px, stop.y_px);
    this.context.stroke();
  }

  dot(point, colour, radius_px) {
    const at = this.toPixel(point);
    if (!at) return;
    this.context.fillStyle = colour;
    this.context.beginPath();
    this.context.arc(at.x_px, at.y_px, radius_px, 0, 2 * Math.PI);
    this.context.fill();
  }

  label(text, point, colour) {
    const at = this.toPixel(point);
    if (!at) return;
    this.context.fillStyle = colour;
    this.context.textAlign = "left";
    this.context.fillText(text, at.x_px + 9, at.y_px - 6);
  }

  note(text, { width_px, height_px }) {
    this.context.fillStyle = css("--quiet");
    this.context.textAlign = "center";
    this.context.fillText(text, width_px / 2, height_px / 2);
  }
}
