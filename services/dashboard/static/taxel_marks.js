// Marks of taxels that are out of order, each a shape and a colour, and their legend.

import { element } from "./dom.js";
import { STATES } from "./taxels.js";

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
export function drawMark(context, state, css) {
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

export function showLegend(list, counts, css) {
  const shown = Object.keys(STATES).filter((state) => counts[state]);
  const key = shown.map((state) => `${state} ${counts[state]}`).join();
  if (list.dataset.shown === key + css("--panel")) return;
  list.dataset.shown = key + css("--panel");
  list.replaceChildren(...shown.map((state) => {
    const scale = window.devicePixelRatio || 1;
    const canvas = element("canvas", { class: "mark", width: LEGEND_PX * scale, height: LEGEND_PX * scale, "aria-hidden": "true" });
    const context = canvas.getContext("2d");
    context.scale(LEGEND_PX * scale, LEGEND_PX * scale);
    drawMark(context, state, css);
    return element("li", { title: STATES[state].text, "data-state": state }, canvas, `${counts[state]} ${state}`);
  }));
}
