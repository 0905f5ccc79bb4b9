// Hands, wrists and head at the playhead in the world: measured skeletons beside the robot's hands.

import { cleared, css } from "../canvas.js";
import { element, setText } from "../dom.js";
import { BONES, frameOfMatrix, frameOfPose, Orbit, TIPS, toWorld } from "./geometry.js";
import { secondsText, stampOf } from "./times.js";

const AXIS_M = 0.05;
const AXIS_COLOURS = ["--axis_x", "--axis_y", "--axis_z"];
const GRID_STEP_M = 0.1;
const GRID_STEPS = 5;
const FINGERS = ["thumb", "index", "middle", "ring", "little"];
const NUM_FINGERS = 5;
const CHAIN_POINTS = 4;
const SIDES = ["left", "right"];

function distanceText(ours, theirs) {
  const parts = ours.map((point, k) => `${FINGERS[k]} ${(1000 * Math.hypot(...point.map((value, axis) => value - theirs[k][axis]))).toFixed(0)}`);
  return `${parts.join(", ")} mm`;
}

export class SpacePane {
  // `tracks`: {poses, keypoints, robots}; `hidden`: layers that are not drawn; `view`: of the URL.
  constructor(root, tracks, { hidden, view, onChange }) {
    this.root = root;
    this.tracks = tracks;
    this.hidden = hidden;
    this.onChange = onChange;
    this.canvas = root.querySelector("canvas");
    this.list = root.querySelector(".own_times");
    this.distances = root.querySelector(".distances");
    this.orbit = new Orbit(view ? { azimuth: view[0], elevation: view[1], distance_m: view[2] } : {});
    this.isTurned = Boolean(view);
    this.isPlaced = false;
    this.scene = { lines: [], points: [], frames: [] };
    this.rows = new Map();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  // The point of view for the URL; null as long as nobody changed it.
  view() {
    return this.isTurned ? [this.orbit.azimuth, this.orbit.elevation, this.orbit.distance_m] : null;
  }

  listen() {
    const turned = () => {
      this.isTurned = true;
      this.draw();
      this.onChange();
    };
    this.canvas.addEventListener("pointerdown", (event) => this.canvas.setPointerCapture(event.pointerId));
    this.canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.orbit.turn(-0.008 * event.movementX, 0.008 * event.movementY);
      turned();
    });
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.orbit.zoom(Math.exp(0.001 * event.deltaY));
      turned();
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => {
      this.place();
      this.draw();
    });
  }

  // The sample of a track at a time; its own time goes below the picture.
  found(track, t_ns) {
    const found = track.sampleAt(t_ns);
    let row = this.rows.get(track.name);
    if (!row) {
      row = element("li", { "data-stream": track.name });
      this.rows.set(track.name, row);
      this.list.append(row);
    }
    const isFound = found.state === "sample";
    const state = isFound ? "shown" : found.error ? "failed" : found.state;
    row.dataset.state = state;
    if (isFound) row.dataset.stamp = stampOf(found.t_ns, track.item.zero);
    else delete row.dataset.stamp;
    const text = isFound ? `${secondsText(Math.round(found.t_ns / 1e5) * 1e5)} s` : found.error?.message ?? (found.state === "none" ? "no sample" : "loading");
    setText(row, `${track.name}: ${text}`);
    return isFound ? found : null;
  }

  show(t_ns) {
    const scene = { lines: [], points: [], frames: [] };
    const frames = new Map();
    for (const track of this.tracks.poses) {
      const sample = this.found(track, t_ns);
      if (!sample) continue;
      for (let at = 0; at < sample.values.length; at += 7) {
        const frame = frameOfPose(sample.values.subarray(at, at + 7));
        if (!frame) continue;
        frames.set(track.name, frame);
        scene.frames.push({ name: sample.values.length > 7 ? `${track.name} ${at / 7}` : track.name, frame });
      }
    }
    const tips = this.measured(scene, frames, t_ns);
    const robot_tips = this.robots(scene, t_ns);
    const pairs = SIDES.filter((side) => tips[side] && robot_tips[side]);
    setText(this.distances, (pairs.length ? "Fingertips apart: " : "") + pairs.map((side) => `${side} ${distanceText(robot_tips[side], tips[side])}`).join(" · "));
    this.scene = scene;
    if (!this.isPlaced && scene.points.length + scene.frames.length > 0) this.place();
    this.draw();
  }

  measured(scene, frames, t_ns) {
    const tips = {};
    for (const track of this.tracks.keypoints) {
      const sample = this.found(track, t_ns);
      const { side } = track.stream;
      // Keypoints that name no frame are in wrist axes.
      const parent = track.stream.frame ?? `wrist_${side}`;
      const hasParent = this.tracks.poses.some((one) => one.name === parent);
      if (!sample || this.hidden.has("measured_hands") || (hasParent && !frames.has(parent))) continue;
      const points = [];
      for (let at = 0; at < sample.values.length; at += 3) {
        const point = [sample.values[at], sample.values[at + 1], sample.values[at + 2]];
        points.push(hasParent ? toWorld(frames.get(parent), point) : point);
      }
      const colour = side === "right" ? "--right" : "--left";
      if (points.length === 25) {
        for (const [from, to] of BONES) scene.lines.push({ from: points[from], to: points[to], colour, width: 2 });
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
      const colour = track.action_kind === "measured" ? "--accent" : "--commanded";
      const absent = new Set(track.item.about.absent);
      for (const side of SIDES.filter((one) => !absent.has(`wrist_${one}`))) {
        const { values } = sample.data.arrays[`${side}_points_world_m`];
        const wrist = frameOfMatrix(sample.data.arrays[`T_world_wrist_${side}`].values, 16 * sample.index).t;
        const at = sample.index * NUM_FINGERS * CHAIN_POINTS;
        const point = (k) => [values[3 * k], values[3 * k + 1], values[3 * k + 2]];
        const found = [];
        for (let finger = 0; finger < NUM_FINGERS; finger += 1) {
          let from = wrist;
          for (let k = 0; k < CHAIN_POINTS; k += 1) {
            const to = point(at + finger * CHAIN_POINTS + k);
            scene.lines.push({ from, to, colour, width: 1.5, isDashed: track.action_kind === "commanded" });
            from = to;
          }
          scene.points.push({ point: from, colour, size: 4 });
          found.push(from);
        }
        if (track.action_kind === "measured") tips[side] = found;
      }
    }
    return tips;
  }

  // Look at the middle of what is there, from where all of it is seen.
  place() {
    const points = [...this.scene.points.map(({ point }) => point), ...this.scene.frames.map(({ frame }) => frame.t)]
      .filter((point) => point.every(Number.isFinite));
    if (!points.length) return;
    const low = [0, 1, 2].map((axis) => Math.min(...points.map((point) => point[axis])));
    const high = [0, 1, 2].map((axis) => Math.max(...points.map((point) => point[axis])));
    this.orbit.target = low.map((value, axis) => (value + high[axis]) / 2);
    this.floor_m = low[2] - 0.05;
    if (!this.isTurned) this.orbit.distance_m = Math.max(0.5, 1.6 * Math.hypot(...high.map((value, axis) => value - low[axis])));
    this.isPlaced = true;
  }

  draw() {
    const found = cleared(this.canvas);
    if (!found) return;
    const { context, width, height, scale } = found;
    const project = this.orbit.projector(width, height);
    const line = (from, to, colour, width_px, isDashed = false) => {
      const [a, b] = [project(from), project(to)];
      if (!a || !b || !Number.isFinite(a.x + a.y + b.x + b.y)) return;
      context.strokeStyle = css(colour);
      context.lineWidth = width_px * scale;
      context.setLineDash(isDashed ? [4 * scale, 3 * scale] : []);
      context.beginPath();
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y);
      context.stroke();
    };
    this.drawFloor(line);
    for (const { frame } of this.scene.frames) {
      AXIS_COLOURS.forEach((colour, axis) => line(frame.t, toWorld(frame, [0, 1, 2].map((k) => (k === axis ? AXIS_M : 0))), colour, 2));
    }
    for (const { from, to, colour, width: width_px, isDashed } of this.scene.lines) line(from, to, colour, width_px, isDashed);
    for (const { point, colour, size } of this.scene.points) {
      const at = project(point);
      if (!at || !Number.isFinite(at.x + at.y)) continue;
      context.fillStyle = css(colour);
      context.beginPath();
      context.arc(at.x, at.y, size * scale, 0, 2 * Math.PI);
      context.fill();
    }
    context.fillStyle = css("--quiet");
    context.font = `${11 * scale}px system-ui, sans-serif`;
    for (const { name, frame } of this.scene.frames) {
      const at = project(frame.t);
      if (at) context.fillText(name, at.x + 6 * scale, at.y - 6 * scale);
    }
  }

  drawFloor(line) {
    const [x0, y0] = this.orbit.target.map((value) => Math.round(value / GRID_STEP_M) * GRID_STEP_M);
    const size = GRID_STEP_M * GRID_STEPS;
    const z = this.floor_m ?? 0;
    for (let k = -GRID_STEPS; k <= GRID_STEPS; k += 1) {
      const at = k * GRID_STEP_M;
      line([x0 + at, y0 - size, z], [x0 + at, y0 + size, z], "--line", 1);
      line([x0 - size, y0 + at, z], [x0 + size, y0 + at, z], "--line", 1);
    }
  }
}
