// Run by test_projection.py, which computes the expected pixels and points with OpenCV and NumPy.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

const { STATIC, CASES } = process.env;
const { fitted, orbitCamera, project, readPoses, scene, turned, zoomed } = await import(`${STATIC}/poses.js`);
const { PADS, padForces, statesOf, taxelName, trusted, withLayout } = await import(`${STATIC}/taxels.js`);
const { cameras, message, sides, pressures, forces, names, heatmap, layout, canvases, own_layout, own_canvases } = JSON.parse(readFileSync(CASES, "utf8"));

const near = (got, expected, tolerance) => got.forEach((value, index) => assert.ok(Math.abs(value - expected[index]) < tolerance, `got ${got}, expected ${expected}`));

test("pixels of points are those of OpenCV", () => {
  assert.ok(cameras.length >= 20);
  for (const { orbit, size, points, pixels } of cameras) {
    const T = orbitCamera(orbit);
    points.forEach((point, index) => {
      const { x_px, y_px } = project(T, point, size);
      near([x_px, y_px], pixels[index], 1e-6);
    });
  }
});

test("the target is in the middle, at its distance", () => {
  for (const { orbit, size } of cameras) {
    const { x_px, y_px, depth_m } = project(orbitCamera(orbit), orbit.target_m, size);
    near([x_px, y_px, depth_m], [size.width_px / 2, size.height_px / 2, orbit.distance_m], 1e-9);
  }
});

test("points behind the camera and missing ones have no pixel", () => {
  const orbit = { target_m: [0, 0, 0], distance_m: 1, azimuth_rad: 0, elevation_rad: 0 };
  const size = { width_px: 100, height_px: 100 };
  assert.equal(project(orbitCamera(orbit), [1.5, 0, 0], size), null);
  assert.equal(project(orbitCamera(orbit), [NaN, 0, 0], size), null);
});

test("dragging never turns over the pole, zooming never through the target", () => {
  let orbit = { target_m: [0, 0, 0], distance_m: 1, azimuth_rad: 0, elevation_rad: 0 };
  for (let step = 0; step < 100; step += 1) orbit = zoomed(turned(orbit, 0, 50), 0.5);
  assert.ok(orbit.elevation_rad < Math.PI / 2 && orbit.distance_m > 0);
  assert.ok(orbitCamera(orbit).every(Number.isFinite));
});

test("after a fit every point is in the picture", () => {
  const size = { width_px: 640, height_px: 400 };
  for (const { orbit, points } of cameras) {
    const T = orbitCamera(fitted(orbit, [...points, [NaN, 0, 0]]));
    for (const point of points) {
      const { x_px, y_px } = project(T, point, size);
      assert.ok(x_px >= 0 && x_px <= size.width_px && y_px >= 0 && y_px <= size.height_px);
    }
  }
});

test("a flat picture follows points that leave it, until somebody chose a view", async () => {
  Object.assign(globalThis, { ResizeObserver: class { observe() {} }, requestAnimationFrame() {} });
  const { OrbitCanvas } = await import(`${STATIC}/canvas.js`);
  for (const size of [{ width_px: 500, height_px: 120 }, { width_px: 120, height_px: 400 }]) {
    const view = new OrbitCanvas({ addEventListener() {} }, { paint() {} });
    const isInside = (point) => {
      const { x_px, y_px } = project(orbitCamera(view.orbit), point, size);
      return x_px >= 0 && x_px <= size.width_px && y_px >= 0 && y_px <= size.height_px;
    };
    view.size = size;
    view.fit([[0, 0, 1], [0.1, 0, 1.1]]);
    const near_m = view.orbit.distance_m;
    const fingers = [[-0.5, 0.2, 0.7], [0.5, -0.2, 1.6]];
    view.fit(fingers);
    assert.ok(fingers.every(isInside) && view.orbit.distance_m > near_m);
    view.move(zoomed(view.orbit, 0.5));
    const chosen = view.orbit;
    view.fit([[-0.5, 0.2, 0.7], [0.5, -0.2, 1.6]]);
    assert.equal(view.orbit, chosen);
  }
});

test("keypoints of the dashboard's message are where NumPy says", () => {
  const bytes = Uint8Array.from(Buffer.from(message, "base64"));
  const streams = readPoses(bytes.buffer);
  assert.deepEqual(streams.map(({ name }) => name), ["head", "wrist_left", "wrist_right", "keypoints_left", "keypoints_right"]);
  assert.deepEqual(streams.map(({ age_s }) => age_s), [null, 0.01, 7.5, 0.02, 0.03]);
  const { bodies, hands } = scene(streams);
  assert.deepEqual(bodies.map(({ name }) => name), ["wrist_left"]);
  assert.deepEqual(hands.map(({ side, placed }) => [side, placed]), [["left", true], ["right", false]]);
  hands[0].points_world.forEach((point, node) => near(point, sides.left[node], 1e-6));
});

const { pads } = heatmap;

test("forces of the pads are those of dextouch.tactile", () => {
  assert.equal(PADS.length, 6);
  near(padForces(Float32Array.from(pressures), 2, pads), forces, 1e-4);
});

test("taxels are named by pad, row and column", () => {
  for (const [taxel, pad, row, column] of names) assert.match(taxelName(taxel, pads), new RegExp(`^${pad}( tip)?, row ${row}, column ${column}$`));
});

test("a taxel shows the gravest of its states, and unknown ones are left out", () => {
  assert.deepEqual([...statesOf({ drifting: [3], dead: [3, 4], shiny: [5] })], [[3, "dead"], [4, "dead"]]);
});

test("taxels out of order count for no force, those with the gain of their pad do", () => {
  const states = statesOf({ saturated: [0], refused: [1] });
  assert.deepEqual([...trusted(Float32Array.of(1700, 20, 30), states)], [0, 20, 30]);
});

test("taxels of another glove are drawn where dextouch.tactile draws them", () => {
  for (const [one, drawn] of [[layout, canvases], [own_layout, own_canvases]]) {
    const { cells, rows, columns, raw_cells } = withLayout(heatmap, one);
    for (const side of ["left", "right"]) {
      const canvas = new Array(rows * columns).fill(-1);
      cells[side].forEach((cell, taxel) => { canvas[cell] = taxel; });
      assert.deepEqual(canvas, drawn[side]);
      assert.deepEqual(raw_cells[side], one.raw_cells[side]);
    }
  }
  assert.equal(withLayout(heatmap, null), heatmap);
});

test("taxels of another glove have its names and areas", () => {
  const found = withLayout(heatmap, layout).pads;
  assert.equal(taxelName(14, found), "thumb tip, row 3, column 5");
  assert.equal(taxelName(75 + 9, found), "palm, row 2, column 1");
  const touch = new Float32Array(138).fill(0);
  touch[0] = touch[137] = 10;
  near(padForces(touch, 2, found), [0.12, 0, 0, 0, 0, 0.8], 1e-6);
});
