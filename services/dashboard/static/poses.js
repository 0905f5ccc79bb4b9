// Newest poses of a station: the binary message, and what is where in the world. No DOM, so that node can test it.

import { apply } from "./projection.js";

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
