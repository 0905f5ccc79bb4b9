// Poses in space: their binary message, the hands and bodies of a scene, and the camera that orbits them; metres, world axes with z up. No DOM, so that node can test it.

const FOVY_RAD = 0.7;
const NEAR_M = 0.02;
const MAX_ELEVATION_RAD = 1.55;
const DISTANCES_M = [0.1, 20];
const RAD_PER_PX = 0.008;
// Of half the picture, what a fit fills.
const FILLED = 0.82;
const LEAST_FIT_M = 0.45;

const dot = (a, b) => a.reduce((sum, value, axis) => sum + value * b[axis], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

// T_a_b (16 numbers, row by row) applied to a point of b.
export function apply(T, point) {
  return [0, 4, 8].map((row) => T[row] * point[0] + T[row + 1] * point[1] + T[row + 2] * point[2] + T[row + 3]);
}

export const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

// T_world_body of a pose x y z w qx qy qz; null for one that was lost (NaN or a quaternion of zeros).
export function matrixOfPose(pose) {
  const [tx, ty, tz, ...q] = pose;
  const norm = Math.hypot(...q);
  if (!Number.isFinite(tx + ty + tz) || !(norm > 1e-9)) return null;
  const [w, x, y, z] = q.map((value) => value / norm);
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), tx,
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), ty,
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), tz, 0, 0, 0, 1,
  ];
}

// T_camera_world of a camera (x right, y down, z forward) that looks at `target_m`; azimuth 0 is on the world's x axis.
export function orbitCamera({ target_m, distance_m, azimuth_rad, elevation_rad }) {
  const outward = [Math.cos(elevation_rad) * Math.cos(azimuth_rad), Math.cos(elevation_rad) * Math.sin(azimuth_rad), Math.sin(elevation_rad)];
  const position_m = target_m.map((value, axis) => value + distance_m * outward[axis]);
  const z = outward.map((value) => -value);
  const x = unit(cross(z, [0, 0, 1]));
  const rows = [x, cross(z, x), z];
  return [...rows.flatMap((row) => [...row, -dot(row, position_m)]), 0, 0, 0, 1];
}

// Pixel and depth of a world point; null behind the camera, and where a coordinate is missing (NaN).
export function project(T_camera_world, point_world, { width_px, height_px }) {
  const [x, y, depth_m] = apply(T_camera_world, point_world);
  if (!(depth_m > NEAR_M) || !Number.isFinite(x + y)) return null;
  const focal_px = height_px / 2 / Math.tan(FOVY_RAD / 2);
  return { x_px: width_px / 2 + (focal_px * x) / depth_m, y_px: height_px / 2 + (focal_px * y) / depth_m, depth_m };
}

export function turned(orbit, dx_px, dy_px) {
  const elevation_rad = orbit.elevation_rad + RAD_PER_PX * dy_px;
  return { ...orbit, azimuth_rad: orbit.azimuth_rad - RAD_PER_PX * dx_px,
    elevation_rad: Math.min(Math.max(elevation_rad, -MAX_ELEVATION_RAD), MAX_ELEVATION_RAD) };
}

export function zoomed(orbit, factor) {
  return { ...orbit, distance_m: Math.min(Math.max(orbit.distance_m * factor, DISTANCES_M[0]), DISTANCES_M[1]) };
}

// The same view direction, moved so that all points fill the picture with a margin.
// `aspect` is the picture's width over its height.
export function fitted(orbit, points_m, aspect = 1) {
  const known = points_m.filter((point) => point.every(Number.isFinite));
  if (known.length === 0) return orbit;
  const edges = [0, 1, 2].map((axis) => known.map((point) => point[axis])).map((values) => [Math.min(...values), Math.max(...values)]);
  const target_m = edges.map(([low, high]) => (low + high) / 2);
  const centred = { ...orbit, target_m };
  const T_camera_world = orbitCamera(centred);
  const needed_m = known.map((point) => {
    const [x, y, depth_m] = apply(T_camera_world, point);
    return Math.max(Math.abs(x) / Math.min(aspect, 1), Math.abs(y)) / (FILLED * Math.tan(FOVY_RAD / 2)) + orbit.distance_m - depth_m;
  });
  return zoomed({ ...centred, distance_m: Math.max(LEAST_FIT_M, ...needed_m) }, 1);
}

export const NUM_KEYPOINTS = 25;
// Keypoints that are fingertips, from the thumb on.
export const TIPS = [4, 9, 14, 19, 24];
// Where a hand is shown whose wrist is not tracked: palm down at the world's origin, 40 cm from the other one.
const UNPLACED = {
  left: [1, 0, 0, -0.2, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1],
  right: [1, 0, 0, 0.2, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1],
};

// uint8 kind (2), uint8 0, uint16 n, n bytes of JSON [[name, age_s or null, number of values], …], float32 values, little endian.
export function readPoses(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(0) !== 2) return null;
  let offset = 4 + view.getUint16(2, true);
  const rows = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, offset - 4)));
  return rows.map(([name, age_s, count]) => {
    const values = new Float32Array(buffer, offset, count);
    offset += 4 * count;
    return { name, age_s, values };
  });
}

function points(values) {
  return Array.from({ length: NUM_KEYPOINTS }, (_, node) => Array.from(values.subarray(3 * node, 3 * node + 3)));
}

// Bodies with a pose at this moment, and hands with keypoints; `placed` where the wrist is tracked, too.
export function scene(streams) {
  const bodies = streams.filter(({ values }) => values.length === 16).map(({ name, values }) => ({ name, T_world_body: values }));
  const hands = [];
  for (const { name, values } of streams.filter((stream) => stream.values.length === 3 * NUM_KEYPOINTS)) {
    const side = name.includes("left") ? "left" : "right";
    const wrist = bodies.find((body) => body.name === `wrist_${side}`);
    const T_world_wrist = wrist?.T_world_body ?? UNPLACED[side];
    hands.push({ name, side, placed: wrist !== undefined, points_world: points(values).map((point) => apply(T_world_wrist, point)) });
  }
  return { bodies, hands };
}
