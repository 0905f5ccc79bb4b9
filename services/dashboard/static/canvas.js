// Canvases that fill their place on the page, the colours of the theme, and a picture of points in space.

import { isModified } from "./dom.js";
import { apply, fitted, orbitCamera, project, turned, zoomed } from "./poses.js";

export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// The canvas in device pixels, cleared; null while it has no size on the page.
export function cleared(canvas) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [Math.round(scale * canvas.clientWidth), Math.round(scale * canvas.clientHeight)];
  if (width === 0 || height === 0) return null;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height, scale };
}

// A function that has `draw` called before the next frame, once however often it is called.
export function beforeNextFrame(draw) {
  let isWaiting = false;
  return () => {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame((now_ms) => {
      isWaiting = false;
      draw(now_ms);
    });
  };
}

const HOME = { target_m: [0, 0, 1], distance_m: 1.5, azimuth_rad: -2.2, elevation_rad: 0.4 };
const AXIS_M = 0.05;
const GRID_M = 0.1;
const GRID_CELLS = 5;
const KEYS = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, 12], ArrowDown: [0, -12] };
const ZOOMS = { "+": 0.9, "-": 1 / 0.9 };

// A 2-D canvas that shows points in space: drag or arrow keys turn, wheel, pinch or + and - zoom, double click or 0 resets.
export class OrbitCanvas {
  // `paint` draws into this, which is then a pen; `view` is an orbit to begin with; `onMove` tells that somebody turned or zoomed.
  constructor(canvas, { paint, view = null, onMove = () => {} }) {
    Object.assign(this, { canvas, paint, onMove, isMoved: view !== null, orbit: { ...HOME, ...view }, fits: false, floor_m: 0 });
    this.request = beforeNextFrame(() => this.draw());
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
      if (isModified(event)) return;
      if (event.key in KEYS) this.move(turned(this.orbit, ...KEYS[event.key]));
      else if (event.key in ZOOMS) this.move(zoomed(this.orbit, ZOOMS[event.key]));
      else if (event.key === "0") this.reset();
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  move(orbit) {
    this.orbit = orbit;
    this.isMoved = true;
    this.request();
    this.onMove();
  }

  reset() {
    this.orbit = HOME;
    this.fits = this.isMoved = false;
    this.request();
    this.onMove();
  }

  isInside(point) {
    const at = project(orbitCamera(this.orbit), point, this.size);
    return at !== null && at.x_px >= 0 && at.x_px <= this.size.width_px && at.y_px >= 0 && at.y_px <= this.size.height_px;
  }

  // The first points, and those after a reset, choose what the picture shows; later ones move in it. Until somebody chose a view, it follows those that leave it.
  fit(points) {
    const known = points.filter((point) => point.every(Number.isFinite));
    if (known.length === 0 || (this.fits && (this.isMoved || known.every((point) => this.isInside(point))))) return;
    const { target_m, distance_m } = fitted(this.orbit, known, this.size.width_px / this.size.height_px);
    const least_m = this.fits ? this.orbit.distance_m : 0;
    this.orbit = { ...this.orbit, target_m, distance_m: this.isMoved ? this.orbit.distance_m : Math.max(distance_m, least_m) };
    this.floor_m = GRID_M * Math.floor(Math.min(...known.map((point) => point[2])) / GRID_M);
    this.fits = true;
  }

  draw() {
    const found = cleared(this.canvas);
    if (!found) return;
    this.context = found.context;
    this.size = { width_px: this.canvas.clientWidth, height_px: this.canvas.clientHeight };
    this.context.setTransform(found.scale, 0, 0, found.scale, 0, 0);
    this.context.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    this.context.lineCap = this.context.lineJoin = "round";
    this.paint();
  }

  // The pen; the picture has to be fitted before its first stroke.
  begin(points) {
    this.fit(points);
    const T_camera_world = orbitCamera(this.orbit);
    this.toPixel = (point) => project(T_camera_world, point, this.size);
    const [x_m, y_m] = this.orbit.target_m.map((value) => GRID_M * Math.round(value / GRID_M));
    const reach_m = GRID_M * GRID_CELLS;
    this.style(css("--line"), 1);
    for (let cell = -GRID_CELLS; cell <= GRID_CELLS; cell += 1) {
      const offset_m = cell * GRID_M;
      this.line([x_m - reach_m, y_m + offset_m, this.floor_m], [x_m + reach_m, y_m + offset_m, this.floor_m]);
      this.line([x_m + offset_m, y_m - reach_m, this.floor_m], [x_m + offset_m, y_m + reach_m, this.floor_m]);
    }
  }

  style(colour, width_px, dashes_px = []) {
    Object.assign(this.context, { strokeStyle: colour, lineWidth: width_px });
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
    Object.assign(this.context, { fillStyle: colour, textAlign: "left" });
    this.context.fillText(text, at.x_px + 9, at.y_px - 6);
  }

  // A body's axes, and how high it is above the floor.
  body(name, T) {
    const origin = [T[3], T[7], T[11]];
    this.style(css("--line"), 1.5);
    this.line(origin, [origin[0], origin[1], this.floor_m]);
    [[AXIS_M, 0, 0], [0, AXIS_M, 0], [0, 0, AXIS_M]].forEach((tip, axis) => {
      this.style(css(`--axis_${"xyz"[axis]}`), 2.5);
      this.line(origin, apply(T, tip));
    });
    this.label(name.replaceAll("_", " "), origin, css("--quiet"));
  }

  note(text) {
    Object.assign(this.context, { fillStyle: css("--quiet"), textAlign: "center" });
    this.context.fillText(text, this.size.width_px / 2, this.size.height_px / 2);
  }
}
