// The playhead: where it is, whether it moves, and how fast. It waits while images are loading.

export const SPEEDS = [0.25, 0.5, 1, 1.5, 2, 4];

const LONGEST_STEP_MS = 250;

export class PlayClock {
  constructor(start_ns, stop_ns) {
    this.start_ns = start_ns;
    this.stop_ns = stop_ns;
    this.t_ns = start_ns;
    this.speed = 1;
    this.playing = false;
    this.last_ms = null;
  }

  seek(t_ns) {
    this.t_ns = Math.round(Math.min(Math.max(t_ns, this.start_ns), this.stop_ns));
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing && this.t_ns >= this.stop_ns) this.t_ns = this.start_ns;
    this.last_ms = null;
  }

  pause() {
    this.playing = false;
    this.last_ms = null;
  }

  // Move to the time of an animation frame, if what belongs there is loaded; whether it moved.
  tick(now_ms, isReadyAt) {
    const passed_ms = this.last_ms === null ? 0 : now_ms - this.last_ms;
    this.last_ms = this.playing ? now_ms : null;
    if (!this.playing || passed_ms <= 0) return false;
    // A tab that was in the background does not jump.
    const next_ns = this.t_ns + Math.min(passed_ms, LONGEST_STEP_MS) * 1e6 * this.speed;
    if (!isReadyAt(Math.min(next_ns, this.stop_ns))) return false;
    this.seek(next_ns);
    if (this.t_ns >= this.stop_ns) this.pause();
    return true;
  }
}
