// Pressures of one hand and marks of its taxels on a canvas. Layout and colours come from the server, which takes them from dextouch.tactile, so that report and page show the same picture.

import { beforeNextFrame, cleared, css } from "./canvas.js";
import { element, setText } from "./dom.js";
import { number } from "./format.js";
import { padForces, PADS, STATES, statesOf, taxelName, trusted, withLayout } from "./taxels.js";

const LEGEND_PX = 16;

function path(context, mark) {
  context.beginPath();
  const corners = {
    cross: [[0.15, 0.15, 0.85, 0.85], [0.85, 0.15, 0.15, 0.85]],
    bar: [[0.12, 0.5, 0.88, 0.5]],
    triangle: [[0.5, 0.08, 0.95, 0.88, 0.05, 0.88, 0.5, 0.08]],
    diamond: [[0.5, 0.02, 0.98, 0.5, 0.5, 0.98, 0.02, 0.5, 0.5, 0.02]],
  };
  for (const [x, y, ...rest] of corners[mark] ?? []) {
    context.moveTo(x, y);
    for (let index = 0; index < rest.length; index += 2) context.lineTo(rest[index], rest[index + 1]);
  }
  if (mark === "ring") context.arc(0.5, 0.5, 0.38, 0, 2 * Math.PI);
  if (mark === "dot") context.arc(0.5, 0.5, 0.16, 0, 2 * Math.PI);
}

// One mark in a cell of size 1 at the origin; its outline in the colour of the ground keeps it visible on every pressure.
function drawMark(context, state) {
  const { mark, level } = STATES[state];
  context.lineCap = context.lineJoin = "round";
  path(context, mark);
  context.strokeStyle = css("--panel");
  context.lineWidth = 0.42;
  context.stroke();
  context.strokeStyle = context.fillStyle = css(`--${level.toLowerCase()}`);
  context.lineWidth = 0.2;
  if (["triangle", "dot"].includes(mark)) context.fill();
  context.stroke();
}

export function showLegend(list, counts) {
  const shown = Object.keys(STATES).filter((state) => counts[state]);
  const key = shown.map((state) => `${state} ${counts[state]}`).join();
  if (list.dataset.shown === key + css("--panel")) return;
  list.dataset.shown = key + css("--panel");
  list.replaceChildren(...shown.map((state) => {
    const scale = window.devicePixelRatio || 1;
    const canvas = element("canvas", { class: "mark", width: LEGEND_PX * scale, height: LEGEND_PX * scale, "aria-hidden": "true" });
    const context = canvas.getContext("2d");
    context.scale(LEGEND_PX * scale, LEGEND_PX * scale);
    drawMark(context, state);
    return element("li", { title: STATES[state].text, "data-state": state }, canvas, `${counts[state]} ${state}`);
  }));
}

const GAP = 0.09;

function box(cells, columns) {
  const rows = cells.map((cell) => Math.floor(cell / columns));
  const cols = cells.map((cell) => cell % columns);
  const [top, left] = [Math.min(...rows), Math.min(...cols)];
  return { top, left, height: Math.max(...rows) - top + 1, width: Math.max(...cols) - left + 1 };
}

export class HandCanvas {
  // `texts` may hold elements for a summary, the forces of the pads, and the taxel under the pointer.
  constructor(canvas, texts, side, heatmap) {
    Object.assign(this, { canvas, texts, side, ownHeatmap: heatmap, pressures_kpa: null, states: new Map(), hovered: null });
    this.setHeatmap(heatmap);
    this.request = beforeNextFrame(() => this.draw());
    for (const name of ["pointermove", "pointerdown"]) canvas.addEventListener(name, (event) => this.hover(event));
    canvas.addEventListener("pointerleave", () => this.hover(null));
    new ResizeObserver(() => this.request()).observe(canvas);
    this.request();
  }

  setHeatmap(heatmap) {
    this.heatmap = heatmap;
    this.cells = heatmap.cells[this.side];
    const boxOf = (pad) => box(this.cells.slice(pad.start, pad.start + pad.rows * pad.columns), heatmap.columns);
    this.fingers = heatmap.pads.filter(({ part }) => part !== "palm").map(boxOf);
    this.palm = heatmap.pads.filter(({ part }) => part === "palm").map(boxOf)[0] ?? null;
    this.unloadedKey = null;
    this.hovered = null;
  }

  // Draw a glove of a layout (JSON of TactileLayout) from now on; null is that of the page's heat map.
  use(layout) {
    const key = layout ? JSON.stringify(layout) : "";
    if (key === (this.layoutKey ?? "")) return;
    this.layoutKey = key;
    this.setHeatmap(withLayout(this.ownHeatmap, layout));
    this.pressures_kpa = null;
    this.request();
  }

  update(pressures_kpa) {
    const count = pressures_kpa.length;
    if (count !== this.cells.length) return this.clear(count ? `${count} taxels of a glove whose layout is not known here` : "no glove is heard");
    this.pressures_kpa = pressures_kpa;
    return this.request();
  }

  clear(words) {
    this.pressures_kpa = null;
    if (this.texts.summary) setText(this.texts.summary, words);
    this.request();
  }

  // Taxels that are out of order, by their state.
  mark(taxels) {
    this.states = statesOf(taxels);
    this.request();
  }

  hover(event) {
    this.hovered = event === null ? null : this.taxelAt(event.offsetX, event.offsetY);
    this.request();
  }

  // The taxel at a place of the canvas in CSS pixels; null between taxels.
  taxelAt(x_px, y_px) {
    const { cell_px, left_px, top_px } = this.placement(this.canvas.clientWidth, this.canvas.clientHeight);
    const [column, row] = [Math.floor((x_px - left_px) / cell_px), Math.floor((y_px - top_px) / cell_px)];
    if (column < 0 || column >= this.heatmap.columns) return null;
    const taxel = this.cells.indexOf(row * this.heatmap.columns + column);
    return taxel < 0 ? null : taxel;
  }

  placement(width, height) {
    const margin = 1;
    const { columns, rows } = this.heatmap;
    const cell_px = Math.min(width / (columns + 2 * margin), height / (rows + 2 * margin));
    return { cell_px, left_px: (width - cell_px * columns) / 2, top_px: (height - cell_px * rows) / 2 };
  }

  draw() {
    const { context, width, height } = cleared(this.canvas) ?? {};
    if (!context) return;
    const { cell_px, left_px, top_px } = this.placement(width, height);
    context.drawImage(this.unloaded(width, height), 0, 0);
    context.setTransform(cell_px, 0, 0, cell_px, left_px, top_px);
    this.drawTaxels(context);
    this.drawMarks(context, { cell_px, left_px, top_px });
    this.showTexts();
  }

  // The hand without pressures, drawn once for a size and theme: most of its taxels are unloaded most of the time.
  unloaded(width, height) {
    const key = [width, height, css("--hand"), css("--cell")].join();
    if (this.unloadedKey === key) return this.unloadedPicture;
    const { cell_px, left_px, top_px } = this.placement(width, height);
    const picture = new OffscreenCanvas(width, height);
    const context = picture.getContext("2d");
    context.setTransform(cell_px, 0, 0, cell_px, left_px, top_px);
    this.drawSilhouette(context);
    context.fillStyle = css("--cell");
    for (const cell of this.cells) this.fillCell(context, cell);
    Object.assign(this, { unloadedKey: key, unloadedPicture: picture });
    return picture;
  }

  fillCell(context, cell) {
    context.beginPath();
    context.roundRect((cell % this.heatmap.columns) + GAP, Math.floor(cell / this.heatmap.columns) + GAP, 1 - 2 * GAP, 1 - 2 * GAP, 0.24);
    context.fill();
  }

  drawSilhouette(context) {
    if (!this.palm) return;
    const { top, left, height, width } = this.palm;
    context.fillStyle = context.strokeStyle = css("--hand");
    context.lineCap = "round";
    context.lineWidth = 4.9;
    for (const pad of this.fingers) {
      const x = pad.left + pad.width / 2;
      const inside = Math.min(Math.max(x, left + 2.5), left + width - 2.5);
      context.beginPath();
      context.moveTo(x, pad.top + 1.9);
      if (inside === x) {
        context.lineTo(x, top + 4);
      } else {
        context.lineTo(x, pad.top + 3);
        context.lineTo(inside, top + 8);
      }
      context.stroke();
    }
    context.beginPath();
    context.roundRect(left - 0.5, top - 0.5, width + 1, height + 1, 2.6);
    context.fill();
  }

  drawTaxels(context) {
    if (!this.pressures_kpa) return;
    const { ramp, full_scale_kpa, contact_kpa } = this.heatmap;
    this.pressures_kpa.forEach((pressure_kpa, taxel) => {
      if (!Number.isFinite(pressure_kpa) || pressure_kpa < contact_kpa / 2) return;
      const share = Math.min(pressure_kpa / full_scale_kpa, 1);
      const [red, green, blue] = ramp[Math.round(share * (ramp.length - 1))];
      context.fillStyle = `rgb(${red} ${green} ${blue})`;
      this.fillCell(context, this.cells[taxel]);
    });
  }

  drawMarks(context, { cell_px, left_px, top_px }) {
    const place = (taxel) => {
      const [row, column] = [Math.floor(this.cells[taxel] / this.heatmap.columns), this.cells[taxel] % this.heatmap.columns];
      context.setTransform(cell_px, 0, 0, cell_px, left_px + column * cell_px, top_px + row * cell_px);
    };
    for (const [taxel, state] of this.states) {
      place(taxel);
      drawMark(context, state);
    }
    if (this.hovered === null) return;
    place(this.hovered);
    context.strokeStyle = css("--ink");
    context.lineWidth = 0.18;
    context.strokeRect(0, 0, 1, 1);
  }

  showTexts() {
    const { summary, forces, taxel } = this.texts;
    const pressures_kpa = this.pressures_kpa;
    const known_kpa = pressures_kpa && trusted(pressures_kpa, this.states);
    if (summary && known_kpa) {
      const touching = known_kpa.filter((value) => value >= this.heatmap.contact_kpa);
      setText(summary, touching.length === 0 ? "no contact" : `${touching.length} taxels in contact, peak ${Math.max(...touching).toFixed(0)} kPa`);
    }
    if (forces) {
      const forces_n = known_kpa ? padForces(known_kpa, this.heatmap.contact_kpa, this.heatmap.pads) : PADS.map(() => null);
      [...forces.children].forEach((value, pad) => setText(value.lastElementChild, number(forces_n[pad], 1, "N")));
    }
    if (taxel) {
      const state = STATES[this.states.get(this.hovered)]?.text ?? "in order";
      const pressure = number(pressures_kpa?.[this.hovered], 1, "kPa");
      setText(taxel, this.hovered === null ? "" : `${taxelName(this.hovered, this.heatmap.pads)}: ${pressure} · ${state}`);
    }
  }
}

export function drawScale(canvas, heatmap) {
  const context = canvas.getContext("2d");
  heatmap.ramp.forEach(([red, green, blue], index) => {
    context.fillStyle = `rgb(${red} ${green} ${blue})`;
    const left = (index / heatmap.ramp.length) * canvas.width;
    context.fillRect(left, 0, canvas.width / heatmap.ramp.length + 1, canvas.height);
  });
}

// Binary message: uint8 kind (1), uint8 side (0 left, 1 right), uint16 count (0 of a glove that is not heard), count × float32 kPa,
// little endian.
export function readTaxels(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(0) !== 1) return null;
  const side = view.getUint8(1) === 0 ? "left" : "right";
  return { side, pressures_kpa: new Float32Array(buffer, 4, view.getUint16(2, true)) };
}
