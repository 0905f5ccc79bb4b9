// Tracks: streams that panes show, loaded in blocks through one queue with one budget of memory.

import { Blocks } from "./blocks.js";

const IMAGES_PER_BLOCK = 8;
const MAX_DECODED_BYTES = 48e6;
const SAMPLES_S = 2;
const MAX_BLOCK_BYTES = 1e6;
const JPEG_SHARE = 0.15;

class Track {
  constructor(queue, name, stream, block_ns, block_bytes) {
    this.queue = queue;
    this.name = name;
    this.stream = stream;
    this.blocks = new Blocks({ ...stream, block_ns });
    this.block_bytes = block_bytes;
  }

  key(index) {
    return `${this.name}/${index}`;
  }

  entry(index, urgent) {
    const span = this.blocks.span(index);
    return { key: this.key(index), bytes: this.block_bytes, urgent, load: (signal) => this.load(span, signal) };
  }

  // What is needed at a time, and what will be until another one, which may be earlier.
  now(t_ns) {
    return this.blocks.at(t_ns).map((index) => this.entry(index, true));
  }

  ahead(t_ns, until_ns) {
    return this.blocks.ahead(t_ns, until_ns).map((index) => this.entry(index, false));
  }

  isReadyAt(t_ns) {
    return this.blocks.at(t_ns).every((index) => this.queue.get(this.key(index)) || this.queue.failure(this.key(index)));
  }

  sampleAt(t_ns) {
    const found = this.blocks.sampleAt(t_ns, (index) => this.queue.get(this.key(index)));
    if (found.state === "loading") found.error = this.queue.failure(this.key(found.block));
    if (found.state === "sample") found.data = this.queue.get(this.key(found.block));
    return found;
  }
}

export class ImageTrack extends Track {
  constructor(queue, item, stream) {
    const images = Math.max(1, Math.min(IMAGES_PER_BLOCK, Math.floor(MAX_DECODED_BYTES / stream.size)));
    super(queue, stream.name, stream, images * stream.period_ns, images * stream.size * JPEG_SHARE);
    this.item = item;
    this.half_size = false;
  }

  key(index) {
    return `${this.name}${this.half_size ? "/half" : ""}/${index}`;
  }

  load(span, signal) {
    return this.item.images(this.stream.name, span, this.half_size, signal);
  }

  // The stamp of the next image after a time (or of the last before it); null if there is none.
  async neighbour(t_ns, direction) {
    return neighbour(this, t_ns, direction, async (span) => (await this.item.images(this.stream.name, span, true)).value);
  }
}

export class SampleTrack extends Track {
  constructor(queue, item, stream) {
    const bytes_per_s = stream.nominal_rate_hz * (8 * stream.size + 24);
    const block_s = Math.max(1 / stream.nominal_rate_hz, Math.min(SAMPLES_S, MAX_BLOCK_BYTES / bytes_per_s));
    super(queue, stream.name, stream, 1e9 * block_s, bytes_per_s * block_s);
    this.item = item;
  }

  load(span, signal) {
    return this.item.samples(this.stream.name, span, signal);
  }

  // Values of the sample that is valid at a time.
  sampleAt(t_ns) {
    const found = super.sampleAt(t_ns);
    if (found.state === "sample") {
      const { size } = this.stream;
      found.values = found.data.values.subarray(found.index * size, (found.index + 1) * size);
    }
    return found;
  }

  async neighbour(t_ns, direction) {
    return neighbour(this, t_ns, direction, async (span) => (await this.item.samples(this.stream.name, span)).value);
  }
}

// Points of the robot hands of an episode's actions.
export class RobotTrack extends Track {
  constructor(queue, item, stream, action_kind) {
    super(queue, `robot ${action_kind}`, stream, 1e9 * SAMPLES_S, SAMPLES_S * 2000 * stream.nominal_rate_hz);
    this.item = item;
    this.action_kind = action_kind;
  }

  load(span, signal) {
    return this.item.robotHands(this.action_kind, span, signal);
  }
}

async function neighbour(track, t_ns, direction, read) {
  const { blocks, stream, queue } = track;
  if (!blocks.count) return null;
  if (direction > 0 && t_ns < stream.first_ns) return stream.first_ns;
  if (direction < 0 && t_ns > stream.last_ns) return stream.last_ns;
  const gap = stream.gaps_ns.find(([from_ns, to_ns]) => (direction > 0 ? from_ns <= t_ns && t_ns < to_ns : from_ns < t_ns && t_ns <= to_ns));
  if (gap) return direction > 0 ? gap[1] : gap[0];
  for (let index = Math.min(blocks.indexAt(t_ns), blocks.count - 1); index >= 0 && index < blocks.count; index += direction) {
    const block = queue.get(track.key(index)) ?? (await read(blocks.span(index)));
    const stamps = direction > 0 ? block.t_ns : block.t_ns.slice().reverse();
    const found = stamps.find((stamp) => (direction > 0 ? stamp > t_ns : stamp < t_ns));
    if (found !== undefined) return found;
  }
  return null;
}
