// Plays the steps of the newest chunk at the world's rate, or waits where the operator paused.

export class StepPlayer {
  constructor({ show, now = () => performance.now() }) {
    this.show = show;
    this.now = now;
    this.count = 0;
    this.index = -1;
    this.paused = false;
    this.rate_hz = 15;
    this.began_ms = 0;
  }

  load(count, rate_hz) {
    this.count = count;
    this.rate_hz = rate_hz || 15;
    this.began_ms = this.now();
    this.index = -1;
    if (this.paused) this.goTo(count - 1);
    else this.tick();
  }

  // More steps behind the ones that are played; what is shown goes on.
  extend(count, rate_hz) {
    if (this.count === 0) {
      this.load(count, rate_hz);
      return;
    }
    // Where all were shown already, the new ones begin now.
    if (this.index === this.count - 1) this.began_ms = this.now() - 1000 * this.index / this.rate_hz;
    this.count = count;
  }

  // Called for every drawn frame of the page.
  tick() {
    if (this.paused || this.count === 0) return;
    const due = Math.floor((this.now() - this.began_ms) / 1000 * this.rate_hz);
    const index = Math.min(due, this.count - 1);
    if (index !== this.index) this.goTo(index);
  }

  goTo(index) {
    this.index = Math.max(0, Math.min(index, this.count - 1));
    if (this.count) this.show(this.index);
  }

  pause(paused) {
    this.paused = paused;
    // Playing goes on from the step that is shown.
    if (!paused) this.began_ms = this.now() - 1000 * Math.max(0, this.index) / this.rate_hz;
  }
}
