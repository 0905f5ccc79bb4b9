// A moment of the player as a query: time, cameras, signals, zoom, what is compared and the point of view.

import { parseSeconds, secondsText } from "./times.js";

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
