// Steps of rollouts and comparisons: their binary messages, their images on a canvas, and the player that shows one after the other.

const STEPS_KIND = 2;
const HEADER_START = 8;

function readHeader(buffer) {
  const length = new DataView(buffer).getUint32(4, true);
  const text = new TextDecoder().decode(new Uint8Array(buffer, HEADER_START, length));
  return { header: JSON.parse(text), offset: HEADER_START + length };
}

// Steps of one response: touch by side, and images by camera, as views of the message.
export function readSteps(buffer) {
  if (new DataView(buffer).getUint8(0) !== STEPS_KIND) return null;
  const { header, offset: start } = readHeader(buffer);
  const count = header.steps.length;
  let offset = start;
  let touch = null;
  if (header.has_touch) {
    touch = new Float32Array(buffer, offset, count * 2 * header.num_taxels);
    offset += touch.byteLength;
  }
  const cameras = header.cameras.map(({ name, height, width }) => {
    const pixels = new Uint8Array(buffer, offset, count * height * width * 3);
    offset += pixels.byteLength;
    return { name, height, width, pixels };
  });
  return { header, touch, cameras };
}

export function touchOf(steps, index, side) {
  if (!steps.touch) return null;
  const { num_taxels } = steps.header;
  const start = (2 * index + (side === "left" ? 0 : 1)) * num_taxels;
  return steps.touch.subarray(start, start + num_taxels);
}

export function imageOf(camera, index) {
  const size = camera.height * camera.width * 3;
  return camera.pixels.subarray(index * size, (index + 1) * size);
}

export function drawRgb(canvas, height, width, rgb) {
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  for (let from = 0, to = 0; from < rgb.length; from += 3, to += 4) {
    image.data[to] = rgb[from];
    image.data[to + 1] = rgb[from + 1];
    image.data[to + 2] = rgb[from + 2];
    image.data[to + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

const KIND = 3;
export const SIDES = ["real", "imagined"];

// Steps of one chunk (see comparison.compared): real first in every array.
export function readChunk(buffer) {
  if (new DataView(buffer).getUint8(0) !== KIND) throw new Error("not a chunk of a comparison");
  const { header, offset } = readHeader(buffer);
  const touch = new Float32Array(buffer, offset, 2 * header.num_steps * 2 * header.num_taxels);
  const pixels = new Uint8Array(buffer, offset + touch.byteLength);
  return { ...header, touch, pixels };
}

// The chunk that holds a step, or null before it has arrived.
export function chunkOf(chunks, step) {
  return chunks.find((one) => one && step >= one.first_step && step < one.first_step + one.num_steps) ?? null;
}

export function stepOf(chunk, step) {
  const index = step - chunk.first_step;
  const size = chunk.height * chunk.width * 3;
  return Object.fromEntries(SIDES.map((side, row) => {
    const place = row * chunk.num_steps + index;
    const count = chunk.num_taxels;
    const taxels = chunk.touch.subarray(place * 2 * count, (place + 1) * 2 * count);
    return [side, { rgb: chunk.pixels.subarray(place * size, (place + 1) * size), left: taxels.subarray(0, count), right: taxels.subarray(count) }];
  }));
}

export function difference(real, imagined) {
  return real.map((value, index) => Math.abs(value - imagined[index]));
}

// Uncertainty of the chunk that holds a step; null at the start, which is given.
export function uncertaintyAt(uncertainties, step) {
  return uncertainties.find((one) => step >= one.first_step && step <= one.last_step) ?? null;
}

// Reason and step of the first unreliable chunk up to a step, which makes the rest unreliable; null if none.
export function firstUnreliable(uncertainties, step) {
  const first = uncertainties.find((one) => one.uncertainty?.outside && one.first_step <= step);
  return first ? { reason: first.uncertainty.reason, step: first.last_step } : null;
}

export class StepPlayer {
  constructor(show) {
    Object.assign(this, { show, count: 0, index: -1, paused: false, rate_hz: 15, began_ms: 0 });
  }

  load(count, rate_hz) {
    this.count = count;
    this.rate_hz = rate_hz || 15;
    this.began_ms = performance.now();
    this.index = -1;
    if (this.paused) this.goTo(count - 1);
    else this.tick();
  }

  // More steps behind the ones that are played; what is shown goes on.
  extend(count, rate_hz) {
    if (this.count === 0) {
      this.load(count, rate_hz);
      return;
    }
    // Where all were shown already, the new ones begin now.
    if (this.index === this.count - 1) this.began_ms = performance.now() - 1000 * this.index / this.rate_hz;
    this.count = count;
  }

  // Called for every drawn frame of the page.
  tick() {
    if (this.paused || this.count === 0) return;
    const due = Math.floor((performance.now() - this.began_ms) / 1000 * this.rate_hz);
    const index = Math.min(due, this.count - 1);
    if (index !== this.index) this.goTo(index);
  }

  goTo(index) {
    this.index = Math.max(0, Math.min(index, this.count - 1));
    if (this.count) this.show(this.index);
  }

  pause(paused) {
    this.paused = paused;
    // Playing goes on from the step that is shown.
    if (!paused) this.began_ms = performance.now() - 1000 * Math.max(0, this.index) / this.rate_hz;
  }
}
