// The command that exports what the list shows or what is selected in it. No DOM here.

import { quote } from "../command.js";
import { FILTERS, midnight } from "./query.js";
import { subjectOf } from "./stage.js";

export const FORMATS = ["mcap", "rrd", "lerobot", "umi"];
const OF_EPISODES = ["lerobot", "umi"];

export function kindsOf(format) {
  return OF_EPISODES.includes(format) ? ["episode"] : ["episode", "recording"];
}

// Items of a kind in these rows: of a take its recording, or the episode that it is played as.
export function itemsOfKind(items, kind) {
  const found = items.flatMap((item) => [{ kind: item.kind, id: item.id }, subjectOf(item)]).filter((one) => one.kind === kind);
  return [...new Map(found.map((one) => [one.id, one])).values()];
}

function destination(format, ids) {
  if (format === "lerobot") return "lerobot/";
  if (format === "umi") return "umi.zarr.zip";
  return ids?.length === 1 ? `${ids[0]}.${format}` : "exports/";
}

function filterWords(filters) {
  const values = { ...filters, from: filters.from && midnight(filters.from), to: filters.to && midnight(filters.to, 1) };
  const flags = { from: "after", to: "before" };
  return FILTERS.filter((name) => values[name]).flatMap((name) => `--${flags[name] ?? name}=${values[name]}`);
}

// `ids` of the selection, null for all that match the filters. Empty for a selection without an item
// of the kind: a command without ids would export the whole store.
export function exportCommand({ format, kind, ids, filters }) {
  if (ids?.length === 0) return "";
  const words = ["dextouch", "export", "--format", format, ...(kind === "recording" ? ["--kind", kind] : [])];
  words.push(...(ids ?? filterWords(filters)), "--to", destination(format, ids));
  return words.map(quote).join(" ");
}
