// The image that is clicked in: zoom around the pointer, move by dragging, and the clicks with the boxes that they give.

import { cleared } from "../canvas.js";

const MAX_ZOOM = 40;
const DRAG_PX = 5;
// Corners of a box differ in one bit along each of its edges.
const EDGES = [1, 2, 4].flatMap((bit) => [...Array(8).keys()].filter((corner) => !(corner & bit)).map((corner) => [corner, corner | bit]));

export class Stage {
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
