// Sounds of the recorder, made by oscillators, and the lines that say whether the robot's hand can follow, which have one of them.

import { find, keep, kept, say } from "./dom.js";

// Frequency in Hz, start and length in s, and the form of the wave.
const TONES = {
  start: [[660, 0, 0.11, "sine"], [990, 0.12, 0.2, "sine"]],
  stop: [[880, 0, 0.11, "sine"], [440, 0.12, 0.22, "sine"]],
  saved: [[523, 0, 0.1, "sine"], [659, 0.1, 0.1, "sine"], [784, 0.2, 0.24, "sine"]],
  follow: [[587, 0, 0.14, "triangle"]],
  problem: [[185, 0, 0.2, "square"], [185, 0.28, 0.34, "square"]],
};
const VOLUME = 0.25;
const RAMP_S = 0.012;

export class Sounds {
  constructor(button) {
    Object.assign(this, { button, isOn: kept("sounds") === "on", context: null });
    button.addEventListener("click", () => this.toggle());
    // Browsers stay silent until the page was used once.
    for (const kind of ["keydown", "pointerdown"]) document.addEventListener(kind, () => this.wake(), { capture: true });
    this.show();
  }

  toggle() {
    this.isOn = !this.isOn;
    keep("sounds", this.isOn ? "on" : "off");
    this.show();
    this.wake();
    this.play("saved");
  }

  show() {
    this.button.textContent = `Sounds: ${this.isOn ? "on" : "off"}`;
    this.button.setAttribute("aria-pressed", String(this.isOn));
  }

  wake() {
    if (!this.isOn) return;
    this.context ??= new AudioContext();
    if (this.context.state === "suspended") this.context.resume();
  }

  play(name) {
    if (!this.isOn || !this.context) return;
    const now_s = this.context.currentTime;
    for (const [frequency_hz, start_s, length_s, form] of TONES[name]) {
      const oscillator = new OscillatorNode(this.context, { frequency: frequency_hz, type: form });
      const gain = new GainNode(this.context, { gain: 0 });
      const [begin_s, end_s] = [now_s + start_s, now_s + start_s + length_s];
      gain.gain.setValueAtTime(0, begin_s);
      gain.gain.linearRampToValueAtTime(VOLUME, begin_s + RAMP_S);
      gain.gain.setValueAtTime(VOLUME, end_s - RAMP_S);
      gain.gain.linearRampToValueAtTime(0, end_s);
      oscillator.connect(gain).connect(this.context.destination);
      oscillator.start(begin_s);
      oscillator.stop(end_s);
    }
  }
}

// Shorter ones an operator cannot react to.
const LASTS_S = 0.3;
// Chosen: rare enough not to annoy, often enough to be missed when the motion was changed.
const QUIET_MS = 5000;

export class FollowLines {
  constructor(sounds) {
    this.lines = Object.fromEntries(["left", "right"].map((side) => [side, find(`hand_${side}_follow`)]));
    Object.assign(this, { sounds, wasLost: false, played_ms: -Infinity });
    this.box = find("follow_sound");
    this.box.checked = kept("follow_sound") !== "no";
    this.box.addEventListener("change", () => keep("follow_sound", this.box.checked ? "yes" : "no"));
  }

  // `following` by side as the station says it; a hand that is not tracked has none.
  show(following, isRecording) {
    for (const [side, line] of Object.entries(this.lines)) {
      const hand = following[side];
      line.hidden = !hand;
      say(line, hand?.message ?? "", hand?.level);
    }
    const isLost = Object.values(following).some(({ level, lasted_s }) => level === "WARN" && lasted_s > LASTS_S);
    const isNew = isLost && !this.wasLost && performance.now() - this.played_ms > QUIET_MS;
    if (isRecording && isNew && this.box.checked) {
      this.sounds.play("follow");
      this.played_ms = performance.now();
    }
    this.wasLost = isLost;
  }
}
