// Countdown for resetting the scene after a saved take; it goes on when the page is loaded anew.

import { keep, kept } from "./kept.js";

const KEPT = "reset_timer";

export class ResetTimer {
  constructor(onEnd) {
    this.onEnd = onEnd;
    this.running = JSON.parse(kept(KEPT, "sessionStorage"));
  }

  start(recording_id, length_s) {
    this.running = { recording_id, ends_ms: Date.now() + 1000 * length_s };
    keep(KEPT, JSON.stringify(this.running), "sessionStorage");
    this.tick();
  }

  cancel() {
    this.running = null;
    keep(KEPT, null, "sessionStorage");
  }

  end() {
    if (!this.running) return;
    this.cancel();
    this.onEnd();
  }

  // Ends with the take that it belongs to: somebody armed the next one.
  keep(recorder) {
    if (this.running && recorder.state !== "unknown" && (recorder.state !== "saved" || recorder.recording_id !== this.running.recording_id)) this.cancel();
  }

  get left_s() {
    return this.running ? Math.max(0, Math.ceil((this.running.ends_ms - Date.now()) / 1000)) : null;
  }

  tick() {
    if (this.running && Date.now() >= this.running.ends_ms) this.end();
  }
}
