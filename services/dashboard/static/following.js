// Whether the robot's hand can follow each tracked one: a line on the hand's card, and one short sound while recording.

import { setText } from "./dom.js";
import { keep, kept } from "./kept.js";

// Shorter ones an operator cannot react to.
const LASTS_S = 0.3;
// Chosen: rare enough not to annoy, often enough to be missed when the motion was changed.
const QUIET_MS = 5000;

export class FollowLines {
  constructor(find, sounds) {
    this.lines = Object.fromEntries(["left", "right"].map((side) => [side, find(`hand_${side}_follow`)]));
    this.sounds = sounds;
    this.wasLost = false;
    this.played_ms = -Infinity;
    this.box = find("follow_sound");
    this.box.checked = kept("follow_sound") !== "no";
    this.box.addEventListener("change", () => keep("follow_sound", this.box.checked ? "yes" : "no"));
  }

  // `following` by side as the station says it; a hand that is not tracked has none.
  show(following, isRecording) {
    for (const [side, line] of Object.entries(this.lines)) {
      const hand = following[side];
      line.hidden = !hand;
      line.dataset.level = hand?.level ?? "";
      setText(line, hand?.message ?? "");
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
