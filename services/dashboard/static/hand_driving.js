// Hands moved from keyboard or gamepad: what is held down becomes shares of the largest speed, chunk after chunk.

import { say } from "./dom.js";

const KEYS = { w: ["forward", 1], s: ["forward", -1], d: ["right", 1], a: ["right", -1], r: ["up", 1], f: ["up", -1],
  e: ["turn", 1], q: ["turn", -1], t: ["tilt", 1], g: ["tilt", -1], " ": ["close", 1], c: ["close", -1] };
const WAIT = ".";
// Of a stick at rest.
const DEAD = 0.15;

// The move of keys that are held down, and of a gamepad of the standard layout.
export function moveOf(held, pad = null) {
  const move = {};
  const add = (name, share) => { if (share) move[name] = Math.max(-1, Math.min(1, (move[name] ?? 0) + share)); };
  for (const key of held) if (KEYS[key]) add(...KEYS[key]);
  if (pad) {
    const axis = (index) => (Math.abs(pad.axes[index] ?? 0) > DEAD ? pad.axes[index] : 0);
    const button = (index) => pad.buttons[index]?.value ?? 0;
    add("right", axis(0));
    add("forward", -axis(1));
    add("turn", axis(2));
    add("up", -axis(3));
    add("close", button(7) - button(6));
    add("tilt", button(5) - button(4));
  }
  return move;
}

export class HandDriving {
  // `send` gets the moves of a chunk and resolves once it was made.
  constructor(pad, sides, send) {
    Object.assign(this, { pad, sides, send, held: new Set(), sending: false, isRefused: false });
    pad.addEventListener("keydown", (event) => {
      const key = event.key.toLowerCase();
      if (event.ctrlKey || event.metaKey || event.altKey || !(key in KEYS || key === WAIT)) return;
      event.preventDefault();
      this.held.add(key);
    });
    pad.addEventListener("keyup", (event) => this.held.delete(event.key.toLowerCase()));
    pad.addEventListener("blur", () => this.held.clear());
  }

  // Called for every drawn frame while hands can be moved. Time in the worlds stands still between chunks.
  async tick() {
    if (this.sending || document.activeElement !== this.pad) return;
    const move = moveOf(this.held, navigator.getGamepads?.().find(Boolean));
    if (!Object.keys(move).length && !this.held.has(WAIT)) this.isRefused = false;
    else if (!this.isRefused) await this.make(move);
  }

  // After a refusal nothing is sent until all keys were let go.
  async make(move) {
    const output = this.pad.querySelector("output");
    this.sending = true;
    say(output, Object.entries(move).map(([name, share]) => `${name} ${share.toFixed(1)}`).join(", ") || "waiting");
    const sides = this.sides.value === "both" ? ["left", "right"] : [this.sides.value];
    try {
      await this.send({ hands: Object.fromEntries(sides.map((side) => [side, move])) });
    } catch (error) {
      this.isRefused = true;
      say(output, error.message, "ERROR");
    } finally {
      this.sending = false;
    }
  }
}
