// Messages of a comparison → images and touch of both worlds at one step.

import { readHeader } from "./step_messages.js";

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
