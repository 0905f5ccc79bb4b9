// Bodies that `dextouch.streams.pack` makes (msgpack): fields, and arrays as typed arrays with their shape.

const TYPES = {
  float32: Float32Array, float64: Float64Array, int64: BigInt64Array, int32: Int32Array, uint8: Uint8Array, uint16: Uint16Array,
};

class Reader {
  constructor(buffer) {
    this.view = new DataView(buffer);
    this.bytes = new Uint8Array(buffer);
    this.at = 0;
  }

  // An unsigned number of 1, 2 or 4 bytes, big endian.
  size(num_bytes) {
    const read = { 1: "getUint8", 2: "getUint16", 4: "getUint32" }[num_bytes];
    const value = this.view[read](this.at);
    this.at += num_bytes;
    return value;
  }

  take(length) {
    if (this.at + length > this.bytes.length) throw new RangeError(`packed body: ends before byte ${this.at + length}`);
    this.at += length;
    return this.bytes.subarray(this.at - length, this.at);
  }

  text(length) {
    return new TextDecoder().decode(this.take(length));
  }

  list(length) {
    return Array.from({ length }, () => this.value());
  }

  map(length) {
    const found = {};
    for (let index = 0; index < length; index += 1) found[this.value()] = this.value();
    return found;
  }

  number(method, num_bytes) {
    const value = this.view[method](this.at);
    this.at += num_bytes;
    return Number(value);
  }

  value() {
    const tag = this.size(1);
    if (tag < 0x80) return tag;
    if (tag < 0x90) return this.map(tag & 0x0f);
    if (tag < 0xa0) return this.list(tag & 0x0f);
    if (tag < 0xc0) return this.text(tag & 0x1f);
    if (tag >= 0xe0) return tag - 0x100;
    switch (tag) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: case 0xc5: case 0xc6: return this.take(this.size(1 << (tag - 0xc4)));
      case 0xca: return this.number("getFloat32", 4);
      case 0xcb: return this.number("getFloat64", 8);
      case 0xcc: case 0xcd: case 0xce: return this.size(1 << (tag - 0xcc));
      case 0xcf: return this.number("getBigUint64", 8);
      case 0xd0: return this.number("getInt8", 1);
      case 0xd1: return this.number("getInt16", 2);
      case 0xd2: return this.number("getInt32", 4);
      case 0xd3: return this.number("getBigInt64", 8);
      case 0xd9: case 0xda: case 0xdb: return this.text(this.size(1 << (tag - 0xd9)));
      case 0xdc: case 0xdd: return this.list(this.size(2 << (tag - 0xdc)));
      case 0xde: case 0xdf: return this.map(this.size(2 << (tag - 0xde)));
      default: throw new RangeError(`packed body: byte ${tag} at ${this.at - 1} begins nothing that is packed`);
    }
  }
}

export function unpack(buffer) {
  const { fields, arrays } = new Reader(buffer).value();
  for (const [name, { dtype, shape, data }] of Object.entries(arrays)) {
    const type = TYPES[dtype];
    if (!type) throw new RangeError(`packed body: array ${name} has the type ${dtype}, which pages do not read`);
    // Copied, because typed arrays begin at multiples of their item's size.
    arrays[name] = { shape, values: new type(data.slice().buffer) };
  }
  return { fields, arrays };
}
