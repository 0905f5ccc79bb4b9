// Blocks of a stream: intervals of equal length that are fetched and kept whole, and the sample that
// is valid at a time. A sample is valid from its stamp for one and a half nominal periods, at most
// until the next one; the store calls longer intervals gaps.

const GAP_PERIODS = 1.5;

export class Blocks {
  // `first_ns` and `last_ns` are null for a stream without samples.
  constructor({ first_ns, last_ns, period_ns, block_ns }) {
    this.first_ns = first_ns;
    this.last_ns = last_ns;
    this.hold_ns = GAP_PERIODS * period_ns;
    this.block_ns = Math.max(1, Math.round(block_ns));
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
