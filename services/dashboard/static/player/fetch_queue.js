// Loads blocks in order of urgency and keeps them within a budget of memory. The caller says again and
// again what it wants; what is no longer wanted is dropped from the queue, and aborted if it runs.

const RETRY_MS = 3000;

export class FetchQueue {
  constructor({ budget_bytes, concurrency = 4, onLoaded = () => {}, now_ms = () => performance.now() }) {
    this.budget_bytes = budget_bytes;
    this.concurrency = concurrency;
    this.onLoaded = onLoaded;
    this.now_ms = now_ms;
    // In order of use, the oldest first.
    this.kept = new Map();
    this.kept_bytes = 0;
    this.running = new Map();
    this.failures = new Map();
    this.queue = [];
    this.wanted = new Set();
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
