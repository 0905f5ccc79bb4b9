// Decoder of the store's binary bodies: msgpack with the maps `fields` and `arrays`, the form that
// dextouch.streams.pack writes. Integers beyond 2^53 become BigInt, so that no nanosecond is lost.

const TYPES = {
  uint8: Uint8Array, bool: Uint8Array, uint16: Uint16Array, int32: Int32Array, int64: BigInt64Array,
  float32: Float32Array, float64: Float64Array,
};
const TEXT = new TextDecoder("utf-8", { fatal: true });

class Reader {
  constructor(buffer) {
    this.buffer = buffer;
    this.view = new DataView(buffer);
    this.at = 0;
  }

  // Length of what follows, in `size` bytes.
  length(size) {
    const at = this.skip(size);
    return size === 1 ? this.view.getUint8(at) : size === 2 ? this.view.getUint16(at) : this.view.getUint32(at);
  }

  skip(count) {
    const at = this.at;
    if (at + count > this.buffer.byteLength) throw new Error(`packed body: ends at byte ${this.buffer.byteLength}, expected ${count} more after ${at}`);
    this.at += count;
    return at;
  }

  bytes(count) {
    return new Uint8Array(this.buffer, this.skip(count), count);
  }

  list(count) {
    return Array.from({ length: count }, () => this.value());
  }

  map(count) {
    const found = new Map();
    for (let k = 0; k < count; k += 1) found.set(this.value(), this.value());
    return Object.fromEntries(found);
  }

  value() {
    const tag = this.view.getUint8(this.skip(1));
    if (tag < 0x80) return tag;
    if (tag < 0x90) return this.map(tag & 0x0f);
    if (tag < 0xa0) return this.list(tag & 0x0f);
    if (tag < 0xc0) return TEXT.decode(this.bytes(tag & 0x1f));
    if (tag >= 0xe0) return tag - 0x100;
    const read = READERS[tag];
    if (!read) throw new Error(`packed body: byte 0x${tag.toString(16)} at ${this.at - 1} is not of the form that the store writes`);
    return read(this);
  }
}

function whole(value) {
  return value >= Number.MIN_SAFE_INTEGER && value <= Number.MAX_SAFE_INTEGER ? Number(value) : value;
}

const READERS = {
  0xc0: () => null,
  0xc2: () => false,
  0xc3: () => true,
  0xc4: (reader) => reader.bytes(reader.length(1)),
  0xc5: (reader) => reader.bytes(reader.length(2)),
  0xc6: (reader) => reader.bytes(reader.length(4)),
  0xca: (reader) => reader.view.getFloat32(reader.skip(4)),
  0xcb: (reader) => reader.view.getFloat64(reader.skip(8)),
  0xcc: (reader) => reader.view.getUint8(reader.skip(1)),
  0xcd: (reader) => reader.view.getUint16(reader.skip(2)),
  0xce: (reader) => reader.view.getUint32(reader.skip(4)),
  0xcf: (reader) => whole(reader.view.getBigUint64(reader.skip(8))),
  0xd0: (reader) => reader.view.getInt8(reader.skip(1)),
  0xd1: (reader) => reader.view.getInt16(reader.skip(2)),
  0xd2: (reader) => reader.view.getInt32(reader.skip(4)),
  0xd3: (reader) => whole(reader.view.getBigInt64(reader.skip(8))),
  0xd9: (reader) => TEXT.decode(reader.bytes(reader.length(1))),
  0xda: (reader) => TEXT.decode(reader.bytes(reader.length(2))),
  0xdb: (reader) => TEXT.decode(reader.bytes(reader.length(4))),
  0xdc: (reader) => reader.list(reader.length(2)),
  0xdd: (reader) => reader.list(reader.length(4)),
  0xde: (reader) => reader.map(reader.length(2)),
  0xdf: (reader) => reader.map(reader.length(4)),
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
  const reader = new Reader(buffer);
  const message = reader.value();
  if (reader.at !== buffer.byteLength) throw new Error(`packed body: ${buffer.byteLength - reader.at} bytes after its end`);
  if (!message || typeof message.fields !== "object" || typeof message.arrays !== "object") {
    throw new Error("packed body: expected a map with the maps 'fields' and 'arrays'");
  }
  const arrays = Object.entries(message.arrays).map(([name, entry]) => [name, typed(name, entry)]);
  return { fields: message.fields, arrays: Object.fromEntries(arrays) };
}
