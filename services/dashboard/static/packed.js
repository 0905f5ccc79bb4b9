// Decoder of the store's binary bodies: msgpack with the maps `fields` and `arrays`, the form that dextouch.streams.pack
// writes. Arrays of 64-bit integers are BigInt64Array, so that no nanosecond is lost.

import { decode } from "./vendor/msgpack/decode.mjs";

const TYPES = {
  uint8: Uint8Array, bool: Uint8Array, uint16: Uint16Array, int32: Int32Array, int64: BigInt64Array,
  float32: Float32Array, float64: Float64Array,
};

function typed(name, { dtype, shape, data }) {
  const Type = TYPES[dtype];
  if (!Type || !Array.isArray(shape) || !(data instanceof Uint8Array)) throw new Error(`array ${name}: got dtype ${dtype}, expected one of ${Object.keys(TYPES)}`);
  const count = shape.reduce((product, axis) => product * axis, 1);
  if (data.byteLength !== count * Type.BYTES_PER_ELEMENT) {
    throw new Error(`array ${name}: got ${data.byteLength} bytes, expected ${count * Type.BYTES_PER_ELEMENT} for [${shape}]`);
  }
  // Typed arrays must begin at a multiple of their element's size; the message does not align them.
  const aligned = data.byteOffset % Type.BYTES_PER_ELEMENT === 0;
  const values = aligned ? new Type(data.buffer, data.byteOffset, count) : new Type(data.slice().buffer);
  return { dtype, shape, values };
}

export function unpack(buffer) {
  const message = decode(buffer);
  if (typeof message?.fields !== "object" || typeof message.arrays !== "object") {
    throw new Error("packed body: expected a map with the maps 'fields' and 'arrays'");
  }
  const arrays = Object.entries(message.arrays).map(([name, entry]) => [name, typed(name, entry)]);
  return { fields: message.fields, arrays: Object.fromEntries(arrays) };
}
