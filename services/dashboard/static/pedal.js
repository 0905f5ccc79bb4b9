// A foot pedal that sends one key, learnt by pressing it and kept in this browser.

import { keep, kept } from "./kept.js";

const NOT_FOR_PEDALS = new Set(["escape", "tab", "shift", "control", "alt", "meta", "capslock", "arrowup", "arrowdown", "arrowleft", "arrowright"]);

export class Pedal {
  constructor(button, { taken, say }) {
    this.button = button;
    this.taken = taken;
    this.say = say;
    this.isLearning = false;
    this.key = kept("pedal");
    button.addEventListener("click", () => this.learn());
    this.show();
  }

  learn() {
    this.isLearning = true;
    this.button.blur();
    this.say("Press your pedal now. Esc keeps things as they are, Delete forgets the pedal.", "WARN");
    this.show();
  }

  // A key while the pedal is being learnt.
  take(event) {
    const key = event.key.toLowerCase();
    if (["shift", "control", "alt", "meta"].includes(key)) return;
    if (key !== "escape" && key !== "delete" && (this.taken(key) || NOT_FOR_PEDALS.has(key))) {
      this.say(`${name(key)} has another meaning on this page: set the pedal to another key, such as F13 or B, and press it.`, "ERROR");
      return;
    }
    this.isLearning = false;
    if (key !== "escape") {
      this.key = key === "delete" ? null : key;
      keep("pedal", this.key);
    }
    this.say(this.key && key !== "escape" ? `Pedal: ${name(this.key)}. Each press is the next step: arm, record, stop, save.` : "", "OK");
    this.show();
  }

  matches(event) {
    return this.key !== null && event.key.toLowerCase() === this.key;
  }

  get name() {
    return this.key === null ? "" : name(this.key);
  }

  show() {
    this.button.textContent = this.isLearning ? "Press your pedal now" : `Pedal: ${this.name || "none"}`;
  }
}

function name(key) {
  if (key === " ") return "Space";
  return key.length === 1 ? key.toUpperCase() : key[0].toUpperCase() + key.slice(1);
}
