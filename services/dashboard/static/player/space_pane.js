// Hands, wrists and head at the playhead in the world: measured skeletons beside the robot's hands.

import { css } from "../canvas.js";
import { element, setText } from "../dom.js";
import { OrbitCanvas } from "../orbit_canvas.js";
import { NUM_KEYPOINTS, TIPS } from "../poses.js";
import { apply, IDENTITY, matrixOfPose } from "../projection.js";
import { secondsText, stampOf } from "./times.js";

const FINGERS = ["thumb", "index", "middle", "ring", "little"];
const CHAIN_POINTS = 4;
const SIDES = ["left", "right"];

function distanceText(ours, theirs) {
  const parts = ours.map((point, k) => `${FINGERS[k]} ${(1000 * Math.hypot(...point.map((value, axis) => value - theirs[k][axis]))).toFixed(0)}`);
  return `${parts.join(", ")} mm`;
}

export class SpacePane {
  // `tracks`: {poses, keypoints, robots}; `hidden`: layers that are not drawn; `view`: of the URL; `bones`: pairs of keypoints.
  constructor(root, tracks, { hidden, view, bones, onChange }) {
    this.tracks = tracks;
    this.hidden = hidden;
    this.bones = bones;
    this.list = root.querySelector(".own_times");
    this.distances = root.querySelector(".distances");
    const orbit = view && { azimuth_rad: view[0], elevation_rad: view[1], distance_m: view[2] };
    this.canvas = new OrbitCanvas(root.querySelector("canvas"), { paint: () => this.paint(), view: orbit, onMove: onChange });
    this.draw = this.canvas.request;
    this.scene = { lines: [], points: [], bodies: [] };
    this.rows = new Map();
  }

  // The point of view for the URL; null as long as nobody changed it.
  view() {
    const { isMoved, orbit } = this.canvas;
    return isMoved ? [orbit.azimuth_rad, orbit.elevation_rad, orbit.distance_m] : null;
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
