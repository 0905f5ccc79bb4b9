// The 67-D action at the playhead as bars in its five blocks; commanded values are ticks beside them.

import { cleared, css } from "../canvas.js";
import { setText } from "../dom.js";
import { componentWords } from "./curves.js";
import { secondsText, stampOf } from "./times.js";

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

export class ActionPane {
  constructor(root, tracks, onPick) {
    this.root = root;
    this.tracks = tracks;
    this.canvas = root.querySelector("canvas");
    this.readout = root.querySelector(".readout");
    this.time = root.querySelector(".own_time");
    this.words = tracks.measured.stream.components.map(componentWords);
    this.values = {};
    this.hovered = null;
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
      setText(this.time, values ? `${secondsText(Math.round(found.t_ns / 1e5) * 1e5)} s` : "");
      if (values) this.root.dataset.stamp = stampOf(found.t_ns, track.item.zero);
      else delete this.root.dataset.stamp;
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
    const found = cleared(this.canvas);
    if (!found) return;
    const { context, width, height, scale } = found;
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
