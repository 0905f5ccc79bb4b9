// Panes of the player at the playhead: images, taxel maps, the action, and hands in the world, each with its sample's own time.

import { cleared, css, OrbitCanvas } from "../canvas.js";
import { element, setText } from "../dom.js";
import { HandCanvas } from "../hands.js";
import { apply, IDENTITY, matrixOfPose, NUM_KEYPOINTS, TIPS } from "../poses.js";
import { componentWords } from "./plots.js";
import { secondsText, stampOf } from "./times.js";

// A sample's own time, in words and as the store's stamp; null of none.
function showStamp(root, node, t_ns, item, { before = "", missing = "" } = {}) {
  setText(node, before + (t_ns === null ? missing : `${secondsText(Math.round(t_ns / 1e5) * 1e5)} s`));
  if (t_ns === null) delete root.dataset.stamp;
  else root.dataset.stamp = stampOf(t_ns, item.zero);
}

// A camera's picture: the image that is valid at the playhead, with the image's own time below it.
export class CameraPane {
  constructor(track, onToggle) {
    this.track = track;
    this.canvas = element("canvas", { role: "img", "aria-label": `image of ${track.stream.name}`, title: "Double-click to enlarge" });
    const [height, width] = track.stream.shape;
    Object.assign(this.canvas, { width, height });
    this.message = element("p", { class: "pane_message" });
    this.time = element("time", { class: "own_time" });
    this.root = element("figure", { class: "camera", "data-camera": track.stream.name, "data-state": "loading" },
      element("div", { class: "picture" }, this.canvas, this.message),
      element("figcaption", {}, element("span", { class: "name" }, track.stream.name), this.time));
    this.canvas.addEventListener("dblclick", onToggle);
    Object.assign(this, { decoded: 0, drawn: 0, drawn_key: "", decoding_key: "" });
  }

  // Half size is enough where the picture is shown small, or changes fast.
  chooseSize(speed) {
    const width_px = this.canvas.clientWidth * (window.devicePixelRatio || 1);
    this.track.half_size = speed >= 2 || (width_px > 0 && 2 * width_px <= this.track.stream.shape[1]);
  }

  show(t_ns) {
    const found = this.track.sampleAt(t_ns);
    this.wanted_key = found.state === "sample" ? `${found.t_ns} ${this.track.half_size}` : "";
    if (found.state === "none") {
      this.drawn = this.decoded;
      this.drawn_key = this.decoding_key = "";
      this.state("none", "no sample");
      showStamp(this.root, this.time, null);
    } else if (found.state === "loading") {
      this.state(found.error ? "failed" : "loading", found.error?.message ?? "");
    } else {
      const image = found.data.images[found.index];
      const key = this.wanted_key;
      if (key === this.drawn_key) {
        // An image that is still being decoded is not wanted any more.
        this.drawn = this.decoded;
        this.decoding_key = "";
        this.state("shown", "");
      } else if (key !== this.decoding_key) this.draw(image, found.t_ns, key);
    }
  }

  state(name, message) {
    this.root.dataset.state = name;
    setText(this.message, message);
  }

  async draw(bytes, t_ns, key) {
    const number = (this.decoded += 1);
    this.decoding_key = key;
    this.state("loading", "");
    let bitmap;
    try {
      // As the sensor delivered it: EXIF orientation is ignored everywhere.
      bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }), { imageOrientation: "none" });
    } catch {
      if (key === this.wanted_key) this.state("failed", "this image cannot be decoded");
      return;
    } finally {
      if (this.decoding_key === key) this.decoding_key = "";
    }
    // Images may be decoded out of order; one that is older than the picture is not shown any more.
    if (number > this.drawn) {
      this.drawn = number;
      this.drawn_key = key;
      if (this.canvas.width !== bitmap.width) Object.assign(this.canvas, { width: bitmap.width, height: bitmap.height });
      this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
      showStamp(this.root, this.time, t_ns, this.track.item);
      if (key === this.wanted_key) this.state("shown", "");
    }
    bitmap.close();
  }
}

const SCALE_NS = 30e9;

// A hand's taxel map. Raw counts have no scale of their own: full colour is the largest count of the first seconds.
export class TouchPane {
  constructor(track, side, heatmap) {
    Object.assign(this, { track, heatmap, side, shown_ns: null });
    this.isRaw = track.stream.unit !== "kPa";
    const canvas = element("canvas", { class: "hand", role: "img", "aria-label": `taxels of ${track.stream.name}, seen from the palm` });
    this.text = element("span", { class: "quiet" });
    this.time = element("time", { class: "own_time" });
    this.root = element("figure", { class: "touch_pane", "data-stream": track.stream.name, "data-state": "loading" },
      canvas, element("figcaption", {}, element("span", { class: "name" }, track.stream.name), this.time, this.text));
    // Raw counts have a text of their own.
    this.hand = new HandCanvas(canvas, this.isRaw ? {} : { summary: this.text }, side, { ...heatmap });
    this.hand.mark({ unmeasured: track.stream.unmeasured_taxels });
    if (this.isRaw) this.scaleRaw();
  }

  async scaleRaw() {
    const { stream, item } = this.track;
    if (stream.first_ns === null) return;
    const span = { start_ns: stream.first_ns, stop_ns: Math.min(stream.last_ns + 1, stream.first_ns + SCALE_NS) };
    const found = await item.signals([`${stream.name}.max`], span, 1).catch(() => null);
    const [largest] = found?.get(`${stream.name}.max`).high ?? [];
    if (!(largest > 0)) return;
    Object.assign(this.hand.heatmap, { full_scale_kpa: largest, contact_kpa: 0 });
    if (this.shown_ns !== null) this.drawHand();
  }

  // The taxels among the cells of a raw sample.
  taxels(values) {
    const cells = this.heatmap.raw_cells[this.side];
    return values.length === this.heatmap.num_raw_cells ? Float32Array.from(cells, (cell) => values[cell]) : Float32Array.from(values);
  }

  drawHand() {
    this.hand.draw();
    if (this.isRaw) setText(this.text, `largest ${Math.max(...this.hand.pressures_kpa)} ${this.track.stream.unit}`);
  }

  clear(words) {
    this.hand.clear(words);
    setText(this.text, words);
  }

  show(t_ns) {
    const found = this.track.sampleAt(t_ns);
    if (found.state === "sample") {
      this.root.dataset.state = "shown";
      if (found.t_ns === this.shown_ns) return;
      this.shown_ns = found.t_ns;
      this.hand.pressures_kpa = this.taxels(found.values);
      this.drawHand();
      showStamp(this.root, this.time, found.t_ns, this.track.item);
    } else if (found.state === "none") {
      this.root.dataset.state = "none";
      this.shown_ns = null;
      this.clear("no sample");
      showStamp(this.root, this.time, null);
    } else {
      this.root.dataset.state = found.error ? "failed" : "loading";
      if (found.error) this.clear(found.error.message);
    }
  }
}

// Value at the full height of a bar: metres, entries of a rotation matrix, radians.
const FULL = { m: 0.5, "": 1, rad: 2 };
const BLOCKS = [
  { name: "left wrist", first: 0, count: 9, scale: "±0.5 m, ±1" },
  { name: "right wrist", first: 9, count: 9, scale: "±0.5 m, ±1" },
  { name: "left joints", first: 18, count: 20, scale: "±2 rad" },
  { name: "right joints", first: 38, count: 20, scale: "±2 rad" },
  { name: "head", first: 58, count: 9, scale: "±0.5 m, ±1" },
];
export const ACTION_SIZE = 67;

// The 67-D action as bars in its five blocks; commanded values are ticks beside them.
export class ActionPane {
  constructor(root, tracks, onPick) {
    const [canvas, readout, time] = ["canvas", ".readout", ".own_time"].map((place) => root.querySelector(place));
    Object.assign(this, { root, tracks, canvas, readout, time, values: {}, hovered: null });
    this.words = tracks.measured.stream.components.map(componentWords);
    this.canvas.addEventListener("pointermove", (event) => this.hover(this.indexAt(event)));
    this.canvas.addEventListener("pointerleave", () => this.hover(null));
    this.canvas.addEventListener("click", (event) => onPick(`action.${this.indexAt(event)}`));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  indexAt(event) {
    const share = event.offsetX / Math.max(this.canvas.clientWidth, 1);
    return Math.min(Math.max(Math.floor(share * ACTION_SIZE), 0), ACTION_SIZE - 1);
  }

  hover(index) {
    this.hovered = index;
    this.read();
  }

  show(t_ns) {
    let changed = false;
    for (const [kind, track] of Object.entries(this.tracks)) {
      const found = track.sampleAt(t_ns);
      if (found.state === "loading") {
        this.root.dataset.state = "loading";
        continue;
      }
      const values = found.values ?? null;
      changed ||= this.values[kind] !== values;
      this.values[kind] = values;
      if (kind !== "measured") continue;
      this.root.dataset.state = values ? "shown" : "none";
      showStamp(this.root, this.time, values ? found.t_ns : null, track.item);
    }
    if (changed) this.draw();
  }

  read() {
    const { measured, commanded } = this.values;
    if (!measured) setText(this.readout, "no sample");
    else if (this.hovered === null) setText(this.readout, "Point at a bar to read it, click to plot it");
    else {
      const { text, unit } = this.words[this.hovered];
      const more = commanded ? `, commanded ${commanded[this.hovered].toFixed(4)}` : "";
      setText(this.readout, `${text}: ${measured[this.hovered].toFixed(4)}${more} ${unit}`);
    }
  }

  draw() {
    const { context, width, height, scale } = cleared(this.canvas) ?? {};
    if (!context) return;
    const bar = width / ACTION_SIZE;
    const label_px = 14 * scale;
    const middle = height / 2, reach = middle - label_px; // names below, scales above the bars
    const quiet = css("--quiet");
    context.font = `${11 * scale}px system-ui, sans-serif`;
    BLOCKS.forEach(({ name, first, count, scale: full }, place) => {
      context.fillStyle = css(place % 2 ? "--panel" : "--hand");
      context.fillRect(first * bar, 0, count * bar, height - label_px);
      context.fillStyle = quiet;
      context.textAlign = "center";
      context.fillText(name, (first + count / 2) * bar, height - 3 * scale, count * bar);
      context.fillText(full, (first + count / 2) * bar, 11 * scale, count * bar);
    });
    const draw = (values, colour, paint) => {
      if (!values) return;
      context.fillStyle = colour;
      values.forEach((value, index) => {
        const share = Math.min(Math.max(value / FULL[this.words[index].unit], -1), 1);
        if (Number.isFinite(share)) paint(index * bar, -share * (reach - 2 * scale));
      });
    };
    draw(this.values.measured, css("--accent"), (x, size) => context.fillRect(x + 0.15 * bar, middle, 0.7 * bar, size || scale));
    draw(this.values.commanded, css("--ink"), (x, size) => context.fillRect(x, middle + size - scale, bar, 2 * scale));
    context.fillStyle = css("--line");
    context.fillRect(0, middle, width, scale);
    this.read();
  }
}

const FINGERS = ["thumb", "index", "middle", "ring", "little"];
const CHAIN_POINTS = 4;
const SIDES = ["left", "right"];

function distanceText(ours, theirs) {
  const parts = ours.map((point, k) => `${FINGERS[k]} ${(1000 * Math.hypot(...point.map((value, axis) => value - theirs[k][axis]))).toFixed(0)}`);
  return `${parts.join(", ")} mm`;
}

// Hands, wrists and head in the world: measured skeletons beside the robot's hands.
export class SpacePane {
  // `tracks`: {poses, keypoints, robots}; `hidden`: layers that are not drawn; `view`: of the URL; `bones`: pairs of keypoints.
  constructor(root, tracks, { hidden, view, bones, onChange }) {
    Object.assign(this, { tracks, hidden, bones, rows: new Map(), scene: { lines: [], points: [], bodies: [] } });
    this.list = root.querySelector(".own_times");
    this.distances = root.querySelector(".distances");
    const orbit = view && { azimuth_rad: view[0], elevation_rad: view[1], distance_m: view[2] };
    this.canvas = new OrbitCanvas(root.querySelector("canvas"), { paint: () => this.paint(), view: orbit, onMove: onChange });
    this.draw = this.canvas.request;
  }

  // The point of view for the URL; null as long as nobody changed it.
  view() {
    const { isMoved, orbit } = this.canvas;
    return isMoved ? [orbit.azimuth_rad, orbit.elevation_rad, orbit.distance_m] : null;
  }

  // The sample of a track at a time; its own time goes below the picture.
  found(track, t_ns) {
    const found = track.sampleAt(t_ns);
    if (!this.rows.has(track.name)) {
      this.rows.set(track.name, element("li", { "data-stream": track.name }));
      this.list.append(this.rows.get(track.name));
    }
    const row = this.rows.get(track.name);
    const isFound = found.state === "sample";
    row.dataset.state = isFound ? "shown" : found.error ? "failed" : found.state;
    const missing = found.error?.message ?? (found.state === "none" ? "no sample" : "loading");
    showStamp(row, row, isFound ? found.t_ns : null, track.item, { before: `${track.name}: `, missing });
    return isFound ? found : null;
  }

  show(t_ns) {
    const scene = { lines: [], points: [], bodies: [] };
    const frames = new Map();
    for (const track of this.tracks.poses) {
      const sample = this.found(track, t_ns);
      if (!sample) continue;
      for (let at = 0; at < sample.values.length; at += 7) {
        const T = matrixOfPose(sample.values.subarray(at, at + 7));
        if (!T) continue;
        frames.set(track.name, T);
        scene.bodies.push({ name: sample.values.length > 7 ? `${track.name} ${at / 7}` : track.name, T });
      }
    }
    const tips = this.measured(scene, frames, t_ns);
    const robot_tips = this.robots(scene, t_ns);
    const pairs = SIDES.filter((side) => tips[side] && robot_tips[side]);
    setText(this.distances, (pairs.length ? "Fingertips apart: " : "") + pairs.map((side) => `${side} ${distanceText(robot_tips[side], tips[side])}`).join(" · "));
    this.scene = scene;
    this.draw();
  }

  measured(scene, frames, t_ns) {
    const tips = {};
    for (const track of this.tracks.keypoints) {
      const sample = this.found(track, t_ns);
      const { side } = track.stream;
      // Keypoints that name no frame are in wrist axes.
      const parent = track.stream.frame ?? `wrist_${side}`;
      const T = this.tracks.poses.some((one) => one.name === parent) ? frames.get(parent) : IDENTITY;
      if (!sample || this.hidden.has("measured_hands") || !T) continue;
      const points = [];
      for (let at = 0; at < sample.values.length; at += 3) points.push(apply(T, sample.values.subarray(at, at + 3)));
      const colour = side === "right" ? "--right" : "--left";
      if (points.length === NUM_KEYPOINTS) {
        for (const [from, to] of this.bones) scene.lines.push({ from: points[from], to: points[to], colour, width: 2 });
        if (side) tips[side] = TIPS.map((index) => points[index]);
      }
      points.forEach((point, index) => scene.points.push({ point, colour, size: TIPS.includes(index) ? 4 : 2 }));
    }
    return tips;
  }

  robots(scene, t_ns) {
    const tips = {};
    for (const track of this.tracks.robots) {
      const sample = this.found(track, t_ns);
      if (!sample || this.hidden.has(track.action_kind)) continue;
      const isMeasured = track.action_kind === "measured";
      const colour = isMeasured ? "--accent" : "--commanded";
      const absent = new Set(track.item.about.absent);
      for (const side of SIDES.filter((one) => !absent.has(`wrist_${one}`))) {
        const { values } = sample.data.arrays[`${side}_points_world_m`];
        const T = sample.data.arrays[`T_world_wrist_${side}`].values.subarray(16 * sample.index);
        const first = 3 * sample.index * FINGERS.length * CHAIN_POINTS;
        const found = FINGERS.map((_, finger) => {
          let from = [T[3], T[7], T[11]];
          for (let k = 0; k < CHAIN_POINTS; k += 1) {
            const to = Array.from(values.subarray(first + 3 * (finger * CHAIN_POINTS + k)).subarray(0, 3));
            scene.lines.push({ from, to, colour, width: 1.5, dashes: isMeasured ? [] : [4, 3] });
            from = to;
          }
          scene.points.push({ point: from, colour, size: 4 });
          return from;
        });
        if (isMeasured) tips[side] = found;
      }
    }
    return tips;
  }

  paint() {
    const pen = this.canvas;
    const { lines, points, bodies } = this.scene;
    pen.begin([...points.map(({ point }) => point), ...bodies.map(({ T }) => [T[3], T[7], T[11]])]);
    for (const { name, T } of bodies) pen.body(name, T);
    for (const { from, to, colour, width, dashes } of lines) {
      pen.style(css(colour), width, dashes);
      pen.line(from, to);
    }
    for (const { point, colour, size } of points) pen.dot(point, css(colour), size);
  }
}
