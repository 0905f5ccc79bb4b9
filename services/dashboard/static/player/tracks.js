// Tracks: streams that panes show, loaded in blocks through one queue with one budget of memory.

const GAP_PERIODS = 1.5;

export class Blocks {
  // `first_ns` and `last_ns` are null for a stream without samples.
  constructor({ first_ns, last_ns, period_ns, block_ns }) {
    Object.assign(this, { first_ns, last_ns, hold_ns: GAP_PERIODS * period_ns, block_ns: Math.max(1, Math.round(block_ns)) });
    this.count = first_ns === null ? 0 : Math.floor((last_ns - first_ns) / this.block_ns) + 1;
  }

  indexAt(t_ns) {
    return Math.floor((t_ns - this.first_ns) / this.block_ns);
  }

  // The span [start, stop) of a block.
  span(index) {
    const start_ns = this.first_ns + index * this.block_ns;
    return { start_ns, stop_ns: start_ns + this.block_ns };
  }

  // Blocks that decide which sample is valid at a time, the latest first.
  at(t_ns) {
    if (!this.count || t_ns < this.first_ns || t_ns > this.last_ns + this.hold_ns) return [];
    const found = [];
    for (let index = Math.min(this.indexAt(t_ns), this.count - 1); index >= 0; index -= 1) {
      if (this.span(index).stop_ns <= t_ns - this.hold_ns) break;
      found.push(index);
    }
    return found;
  }

  // Blocks after a time, in order, up to a later time.
  ahead(t_ns, until_ns) {
    if (!this.count) return [];
    const found = [];
    const last = Math.min(this.indexAt(until_ns), this.count - 1);
    for (let index = Math.max(this.indexAt(t_ns) + 1, 0); index <= last; index += 1) found.push(index);
    return found;
  }

  // The sample that is valid at a time: {state: "sample", block, index, t_ns}, or {state: "none"},
  // or {state: "loading", block} as long as `get(block)` has nothing. Blocks hold `t_ns` in order.
  sampleAt(t_ns, get) {
    for (const number of this.at(t_ns)) {
      const block = get(number);
      if (!block) return { state: "loading", block: number };
      const index = lastAtOrBefore(block.t_ns, t_ns);
      if (index >= 0) {
        const found = block.t_ns[index];
        return t_ns - found <= this.hold_ns ? { state: "sample", block: number, index, t_ns: found } : { state: "none" };
      }
    }
    return { state: "none" };
  }
}

export function lastAtOrBefore(stamps, t_ns) {
  let low = 0;
  let high = stamps.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (stamps[middle] <= t_ns) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

const RETRY_MS = 3000;

export class FetchQueue {
  constructor({ budget_bytes, concurrency = 4, onLoaded = () => {}, now_ms = () => performance.now() }) {
    Object.assign(this, { budget_bytes, concurrency, onLoaded, now_ms });
    // `kept` is in order of use, the oldest first.
    Object.assign(this, { kept: new Map(), kept_bytes: 0, running: new Map(), failures: new Map(), queue: [], wanted: new Set() });
  }

  get(key) {
    return this.kept.get(key)?.value;
  }

  // Why a block could not be loaded, as long as it is not loaded anew.
  failure(key) {
    return this.failures.get(key)?.error;
  }

  // Entries {key, bytes, load(signal) → {value, bytes}, urgent}, the most urgent first; `bytes` is what
  // is expected. Those that do not fit in the budget are left out, unless they are urgent.
  want(entries) {
    let left_bytes = this.budget_bytes;
    const accepted = [];
    for (const entry of entries) {
      left_bytes -= this.kept.get(entry.key)?.bytes ?? entry.bytes;
      if (left_bytes < 0 && !entry.urgent) break;
      accepted.push(entry);
    }
    this.wanted = new Set(accepted.map((entry) => entry.key));
    for (const { key } of accepted) this.touch(key);
    this.queue = accepted.filter(({ key }) => !this.kept.has(key));
    for (const [key, abort] of this.running) if (!this.wanted.has(key)) abort.abort();
    this.evict();
    this.start();
  }

  touch(key) {
    const entry = this.kept.get(key);
    if (!entry) return;
    this.kept.delete(key);
    this.kept.set(key, entry);
  }

  evict() {
    for (const [key, entry] of this.kept) {
      if (this.kept_bytes <= this.budget_bytes) return;
      if (this.wanted.has(key)) continue;
      this.kept.delete(key);
      this.kept_bytes -= entry.bytes;
    }
  }

  start() {
    for (const entry of this.queue) {
      if (this.running.size >= this.concurrency) return;
      const failed = this.failures.get(entry.key);
      if (this.running.has(entry.key) || (failed && this.now_ms() - failed.at_ms < RETRY_MS)) continue;
      this.load(entry);
    }
  }

  async load({ key, load }) {
    const abort = new AbortController();
    this.running.set(key, abort);
    try {
      const { value, bytes } = await load(abort.signal);
      this.failures.delete(key);
      if (!this.kept.has(key)) this.kept_bytes += bytes;
      this.kept.set(key, { value, bytes });
    } catch (error) {
      if (!abort.signal.aborted) this.failures.set(key, { error, at_ms: this.now_ms() });
    }
    this.running.delete(key);
    this.queue = this.queue.filter((entry) => !this.kept.has(entry.key));
    this.evict();
    this.onLoaded(key);
    this.start();
  }
}

const IMAGES_PER_BLOCK = 8;
const MAX_DECODED_BYTES = 48e6;
const SAMPLES_S = 2;
const MAX_BLOCK_BYTES = 1e6;
const JPEG_SHARE = 0.15;

class Track {
  constructor(queue, item, stream, { name = stream.name, block_ns, block_bytes }) {
    Object.assign(this, { queue, item, name, stream, block_bytes, blocks: new Blocks({ ...stream, block_ns }) });
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

  read(span) {
    return this.load(span);
  }

  // The stamp of the next sample after a time (or of the last before it); null if there is none.
  async neighbour(t_ns, direction) {
    const { blocks, stream, queue } = this;
    if (!blocks.count) return null;
    if (direction > 0 && t_ns < stream.first_ns) return stream.first_ns;
    if (direction < 0 && t_ns > stream.last_ns) return stream.last_ns;
    const gap = stream.gaps_ns.find(([from_ns, to_ns]) => (direction > 0 ? from_ns <= t_ns && t_ns < to_ns : from_ns < t_ns && t_ns <= to_ns));
    if (gap) return direction > 0 ? gap[1] : gap[0];
    for (let index = Math.min(blocks.indexAt(t_ns), blocks.count - 1); index >= 0 && index < blocks.count; index += direction) {
      const block = queue.get(this.key(index)) ?? (await this.read(blocks.span(index))).value;
      const stamps = direction > 0 ? block.t_ns : block.t_ns.slice().reverse();
      const found = stamps.find((stamp) => (direction > 0 ? stamp > t_ns : stamp < t_ns));
      if (found !== undefined) return found;
    }
    return null;
  }
}

export class ImageTrack extends Track {
  constructor(queue, item, stream) {
    const images = Math.max(1, Math.min(IMAGES_PER_BLOCK, Math.floor(MAX_DECODED_BYTES / stream.size)));
    super(queue, item, stream, { block_ns: images * stream.period_ns, block_bytes: images * stream.size * JPEG_SHARE });
    this.half_size = false;
  }

  key(index) {
    return `${this.name}${this.half_size ? "/half" : ""}/${index}`;
  }

  load(span, signal) {
    return this.item.images(this.stream.name, span, this.half_size, signal);
  }

  read(span) {
    return this.item.images(this.stream.name, span, true);
  }
}

export class SampleTrack extends Track {
  constructor(queue, item, stream) {
    const bytes_per_s = stream.nominal_rate_hz * (8 * stream.size + 24);
    const block_s = Math.max(1 / stream.nominal_rate_hz, Math.min(SAMPLES_S, MAX_BLOCK_BYTES / bytes_per_s));
    super(queue, item, stream, { block_ns: 1e9 * block_s, block_bytes: bytes_per_s * block_s });
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
}

// Points of the robot hands of an episode's actions.
export class RobotTrack extends Track {
  constructor(queue, item, stream, action_kind) {
    super(queue, item, stream, { name: `robot ${action_kind}`, block_ns: 1e9 * SAMPLES_S, block_bytes: SAMPLES_S * 2000 * stream.nominal_rate_hz });
    this.action_kind = action_kind;
  }

  load(span, signal) {
    return this.item.robotHands(this.action_kind, span, signal);
  }
}
