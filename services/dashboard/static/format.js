// Numbers, dates and times as an operator reads them; null and undefined are "–", never a zero that nobody measured.

const MISSING = "–";

export function number(value, digits = 1, unit = "") {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  const text = value.toFixed(digits);
  return unit ? `${text} ${unit}` : text;
}

export function plural(count, name) {
  return `${count} ${name}${count === 1 ? "" : "s"}`;
}

export function count(value) {
  return value === null || value === undefined ? MISSING : String(value);
}

export function age(value_s) {
  if (value_s === null || value_s === undefined || !Number.isFinite(value_s)) return MISSING;
  if (value_s < 1) return `${Math.round(value_s * 1000)} ms`;
  if (value_s < 120) return `${value_s.toFixed(1)} s`;
  if (value_s < 2 * 3600) return `${Math.round(value_s / 60)} min`;
  return value_s < 48 * 3600 ? `${Math.round(value_s / 3600)} h` : `${Math.round(value_s / 86400)} days`;
}

const UNITS = ["B", "kB", "MB", "GB", "TB", "PB"];

export function bytes(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  // As it is rounded: 999.6 MB is 1.0 GB.
  const unit = UNITS.findIndex((_, power) => power === UNITS.length - 1 || Math.round(Math.abs(value) / 1000 ** power) < 1000);
  const shown = value / 1000 ** unit;
  return `${shown.toFixed(unit < 2 || shown >= 100 ? 0 : 1)} ${UNITS[unit]}`;
}

export function stopwatch(value_s) {
  const seconds = Math.max(0, value_s ?? 0);
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

const form = (options) => new Intl.DateTimeFormat("en-GB", options);
const FORMS = {
  moment: form({ dateStyle: "medium", timeStyle: "medium" }),
  day: form({ dateStyle: "medium" }),
  time: form({ timeStyle: "medium" }),
  minute: form({ timeStyle: "short" }),
};

// `at` is ISO text or seconds since 1970; what is not known, or no time, is "–".
export function date(at, name = "moment") {
  const moment = new Date(typeof at === "number" ? 1000 * at : at ?? "");
  return Number.isNaN(moment.getTime()) ? "–" : FORMS[name].format(moment);
}
