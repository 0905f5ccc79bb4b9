// Geometry of the 3-D view: poses as x y z w qx qy qz, and a camera that orbits a point of the world.

// Rows of the rotation matrix of a unit quaternion.
function rotation([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// A frame {R, t} of a pose; null for one that was lost (NaN or a quaternion of zeros).
export function frameOfPose(pose) {
  const t = [pose[0], pose[1], pose[2]];
  const q = [pose[3], pose[4], pose[5], pose[6]];
  const norm = Math.hypot(...q);
  if (!t.every(Number.isFinite) || !(norm > 1e-9)) return null;
  return { R: rotation(q.map((value) => value / norm)), t };
}

export function frameOfMatrix(m, at = 0) {
  const row = (k) => [m[at + 4 * k], m[at + 4 * k + 1], m[at + 4 * k + 2]];
  return { R: [row(0), row(1), row(2)], t: [m[at + 3], m[at + 7], m[at + 11]] };
}

// A point of a frame in the world.
export function toWorld({ R, t }, point) {
  return [dot(R[0], point) + t[0], dot(R[1], point) + t[1], dot(R[2], point) + t[2]];
}

// Perspective projection from azimuth and elevation (radians) at a distance of the target (metres);
// z is up. Gives {x, y, depth} in pixels, or null behind the camera.
export class Orbit {
  constructor({ azimuth = -2.2, elevation = 0.45, distance_m = 1.5, target = [0, 0, 0] } = {}) {
    Object.assign(this, { azimuth, elevation, distance_m, target });
  }

  turn(by_azimuth, by_elevation) {
    this.azimuth += by_azimuth;
    this.elevation = Math.min(Math.max(this.elevation + by_elevation, -1.5), 1.5);
  }

  zoom(factor) {
    this.distance_m = Math.min(Math.max(this.distance_m * factor, 0.05), 50);
  }

  projector(width_px, height_px) {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    const backward = [ce * ca, ce * sa, se];
    const right = [-sa, ca, 0];
    const up = [-se * ca, -se * sa, ce];
    const focal_px = 1.2 * Math.min(width_px, height_px);
    return (point) => {
      const from = [point[0] - this.target[0], point[1] - this.target[1], point[2] - this.target[2]];
      const depth = this.distance_m - dot(backward, from);
      if (!(depth > 0.01)) return null;
      return {
        x: width_px / 2 + (focal_px * dot(right, from)) / depth,
        y: height_px / 2 - (focal_px * dot(up, from)) / depth,
        depth,
      };
    };
  }
}

// Pairs of the 25 keypoints that bones join: the wrist, then thumb (4) and four fingers (5 each), from
// the palm outwards, the order of dextouch.hands.NODES.
export const BONES = (() => {
  const bones = [];
  let first = 1;
  for (const length of [4, 5, 5, 5, 5]) {
    bones.push([0, first]);
    for (let k = first; k < first + length - 1; k += 1) bones.push([k, k + 1]);
    first += length;
  }
  return bones;
})();
export const TIPS = [4, 9, 14, 19, 24];
