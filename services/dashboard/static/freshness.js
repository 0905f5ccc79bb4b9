// Notices that nothing new came for a while, so that no page shows an old value as a new one.

export class Freshness {
  constructor(limit_ms, onStale) {
    this.limit_ms = limit_ms;
    this.onStale = onStale;
    this.timer = null;
  }

  note() {
    clearTimeout(this.timer);
    this.timer = setTimeout(this.onStale, this.limit_ms);
  }

  stop() {
    clearTimeout(this.timer);
  }
}
