// Times of the player: whole nanoseconds after the item's zero, exact as Numbers for 104 days, the playhead, and the address of a moment. Stamps of the
// store are int64 and may be larger than a Number holds, so they are subtracted as BigInt.

const NS_PER_S = 1_000_000_000n;

// JSON whose large integers become BigInt (where the browser tells their text).
export function parseExact(text) {
  return JSON.parse(text, (_, value, context) => {
    const source = context?.source;
    return typeof value === "number" && !Number.isSafeInteger(value) && /^-?\d+$/.test(source ?? "") ? BigInt(source) : value;
  });
}

export function after(stamp, zero) {
  return Number(BigInt(stamp) - zero);
}

export function allAfter(stamps, zero) {
  return Float64Array.from(stamps, (stamp) => Number(stamp - zero));
}

// The store's stamp of a time of the player, as text for a query.
export function stampOf(t_ns, zero) {
  return String(zero + BigInt(Math.round(t_ns)));
}

// Seconds without loss: 1500000000 is "1.5".
export function secondsText(t_ns) {
  const ns = BigInt(Math.round(t_ns));
  const size = ns < 0n ? -ns : ns;
  const rest = String(size % NS_PER_S).padStart(9, "0").replace(/0+$/, "");
  return `${ns < 0n ? "-" : ""}${size / NS_PER_S}${rest ? `.${rest}` : ""}`;
}

// Nanoseconds of such a text; null if it is none.
export function parseSeconds(text) {
  const match = /^(-?)(\d{1,7})(?:\.(\d{1,9})\d*)?$/.exec(text ?? "");
  if (!match) return null;
  const ns = Number(match[2]) * 1e9 + Number((match[3] ?? "").padEnd(9, "0"));
  return match[1] && ns ? -ns : ns;
}

// As an operator reads it: 83.4567 s are "1:23.457".
export function clockText(t_ns) {
  const ms = Math.round(Math.abs(t_ns) / 1e6);
  const minutes = Math.floor(ms / 60_000);
  const seconds = ((ms % 60_000) / 1000).toFixed(3).padStart(6, "0");
  return `${t_ns < 0 && ms ? "−" : ""}${minutes}:${seconds}`;
}

// Marks of a ruler: multiples of 1, 2 or 5 times a power of ten seconds, about `wanted` of them.
export function ticks(from_ns, to_ns, wanted) {
  const rough = Math.max((to_ns - from_ns) / Math.max(wanted, 1), 1e3);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((one) => one >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(from_ns / step); k * step <= to_ns; k += 1) found.push(k * step);
  return { step_ns: step, at_ns: found };
}

// Seconds with as many digits as marks of this distance need.
export function tickText(t_ns, step_ns) {
  const digits = Math.min(9, Math.max(0, -Math.floor(Math.log10(step_ns / 1e9) + 1e-9)));
  return (t_ns / 1e9).toFixed(digits);
}

export const SPEEDS = [0.25, 0.5, 1, 1.5, 2, 4];

const LONGEST_STEP_MS = 250;

export class PlayClock {
  constructor(start_ns, stop_ns) {
    Object.assign(this, { start_ns, stop_ns, t_ns: start_ns, speed: 1, playing: false, last_ms: null });
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

const VIEW_NUMBERS = 3;

function names(text) {
  return text === null ? null : text.split(",").filter((name) => name);
}

function span(text) {
  const [from_ns, to_ns] = (text ?? "").split("~").map(parseSeconds);
  return Number.isFinite(from_ns) && Number.isFinite(to_ns) && from_ns < to_ns ? [from_ns, to_ns] : null;
}

function numbers(text) {
  const found = (text ?? "").split("~").map(Number);
  return text && found.length === VIEW_NUMBERS && found.every(Number.isFinite) ? found : null;
}

// What is absent or not understood is null, which means the default.
export function parseState(query) {
  const fields = new URLSearchParams(query);
  const speed = Number(fields.get("speed") ?? 1);
  return {
    at_ns: parseSeconds(fields.get("at")),
    cameras: names(fields.get("cameras")),
    signals: names(fields.get("signals")),
    zoom_ns: span(fields.get("zoom")),
    view: numbers(fields.get("view")),
    raw: fields.get("raw") === "1",
    hidden: names(fields.get("hide")) ?? [],
    speed: speed >= 0.25 && speed <= 4 ? speed : 1,
  };
}

export function formatState({ at_ns, cameras, signals, zoom_ns, view, raw, hidden, speed }) {
  const fields = [["at", secondsText(at_ns)]];
  if (cameras) fields.push(["cameras", cameras.join(",")]);
  if (signals) fields.push(["signals", signals.join(",")]);
  if (zoom_ns) fields.push(["zoom", zoom_ns.map(secondsText).join("~")]);
  if (view) fields.push(["view", view.map((value) => Number(value.toFixed(3))).join("~")]);
  if (raw) fields.push(["raw", "1"]);
  if (hidden?.length) fields.push(["hide", hidden.join(",")]);
  if (speed && speed !== 1) fields.push(["speed", String(speed)]);
  // Commas and tildes are allowed in a query and easier to read than their escapes.
  return fields.map(([name, value]) => `${name}=${encodeURIComponent(value).replaceAll("%2C", ",")}`).join("&");
}
