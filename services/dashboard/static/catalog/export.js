// Dialog that exports what is selected or filtered: the command, and a download of MCAP files.

import { button, commandLine, element, newestOnly, onSubmit, quote, say, setText } from "../dom.js";
import { bytes, plural } from "../format.js";
import { get, send } from "../requests.js";
import { subjectOf } from "./items.js";
import { FILTERS, midnight, storeQuery } from "./query.js";

const OF_EPISODES = ["lerobot", "umi"];

function kindsOf(format) {
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

const BROKE_OFF = "The download broke off; the log of the store says why. Nothing was saved.";

function save(parts, name) {
  const url = URL.createObjectURL(new Blob(parts));
  element("a", { href: url, download: name }).click();
  // The browser reads it after the click.
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

async function fetchAll(body, signal, onProgress) {
  const answer = await send("/v1/episode_store/downloads", body, { signal });
  const expected = Number(answer.headers.get("x-dextouch-estimated-bytes")) || 1;
  const [, name] = /filename="([^"]+)"/.exec(answer.headers.get("content-disposition") ?? "") ?? [null, "dextouch.mcap"];
  const parts = [];
  let received = 0;
  for (const reader = answer.body.getReader(); ;) {
    const { done, value } = await reader.read().catch((error) => {
      throw signal.aborted ? error : new Error(BROKE_OFF);
    });
    if (done) break;
    parts.push(value);
    received += value.length;
    onProgress(received, expected);
  }
  return { parts, name, received };
}

// A button, and what shows how far it is. `listed` gives the body of the request, when it is pressed.
export function downloadControl(listed) {
  let aborting = null;
  const cancel = button("Cancel download", () => aborting?.abort(), { hidden: "" });
  const bar = element("progress", { max: "1", hidden: "", "aria-label": "download" });
  const note = element("span", { class: "note", role: "status" });
  const showBusy = (busy) => {
    start.disabled = busy;
    cancel.hidden = bar.hidden = !busy;
    bar.removeAttribute("value");
  };
  const start = button("Download MCAP", async () => {
    aborting = new AbortController();
    showBusy(true);
    say(note, "The store makes the files.");
    try {
      const { parts, name, received } = await fetchAll(await listed(), aborting.signal, (some, expected) => {
        // The estimate is of the stored bytes; the end is known only when it is there.
        bar.value = Math.min(some / expected, 0.99);
        say(note, `${bytes(some)} of about ${bytes(expected)}`);
      });
      save(parts, name);
      say(note, `${name}, ${bytes(received)}`);
    } catch (error) {
      if (aborting.signal.aborted) say(note, "Cancelled; nothing was saved.", "WARN");
      else say(note, error.message, "ERROR");
    }
    showBusy(false);
  }, { class: "primary" });
  return element("div", { class: "download" }, start, bar, cancel, note);
}

// More than a store lets be downloaded at once, unless its settings were changed.
const MAX_LISTED = 1000;

function pageOf(query, kind, page) {
  return get(`/v1/episode_store/catalog/items?${storeQuery({ ...query, view: kind, page })}`);
}

async function matching(query, kind) {
  const items = [];
  for (let page = 1; ; page += 1) {
    const found = await pageOf(query, kind, page);
    if (found.num_matching > MAX_LISTED) {
      throw new Error(`${found.num_matching} items are too many for a download; the command has no limit.`);
    }
    items.push(...found.items.map(({ id }) => ({ kind, id })));
    if (items.length >= found.num_matching || !found.items.length) return items;
  }
}

export class ExportDialog {
  #dialog;
  #form;
  #command = commandLine();
  #query;
  #rows = [];
  #showCount = newestOnly(async ({ items, kind }) => [items?.length ?? (await pageOf(this.#query, kind, 1)).num_matching, kind],
    ([count, kind]) => setText(this.#dialog.querySelector("[data-count]"), count ? plural(count, kind) : `no ${kind}`), (error) => setText(this.#dialog.querySelector("[data-count]"), error.message));

  constructor(dialog) {
    this.#dialog = dialog;
    this.#form = dialog.querySelector("[data-choices]");
    const download = downloadControl(() => this.#listed());
    dialog.querySelector("[data-body]").replaceChildren(this.#command.node,
      element("p", { class: "quiet" }, "The command runs on the computer of the store; with another data folder than its default, add --store. Items that were rejected in review are left out, unless they are selected or filtered."),
      download);
    this.#form.addEventListener("input", () => this.#show());
    onSubmit(this.#form);
  }

  // `rows` are the selected items, empty for none.
  open(query, rows) {
    this.#query = query;
    this.#rows = rows;
    const { what, kind } = this.#form.elements;
    what.querySelector("[value=selected]").disabled = !rows.length;
    what.value = rows.length ? "selected" : "filtered";
    if (query.view !== "take") kind.value = query.view;
    this.#dialog.showModal();
    this.#show();
  }

  #chosen() {
    const { what, kind, format } = this.#form.elements;
    const isSelection = what.value === "selected";
    const items = isSelection ? itemsOfKind(this.#rows, kind.value) : null;
    return { format: format.value, kind: kind.value, items, ids: items && items.map(({ id }) => id) };
  }

  async #listed() {
    const { kind, items } = this.#chosen();
    const found = items ?? await matching(this.#query, kind);
    if (!found.length) throw new Error(`No ${kind} is selected.`);
    return { items: found, with_rejected: items !== null || this.#query.filters.review !== "" };
  }

  #show() {
    const { kind, format } = this.#form.elements;
    const kinds = kindsOf(format.value);
    for (const option of kind.options) option.disabled = !kinds.includes(option.value);
    if (!kinds.includes(kind.value)) [kind.value] = kinds;
    const chosen = this.#chosen();
    const command = exportCommand({ ...chosen, filters: this.#query.filters });
    this.#command.show(command);
    this.#command.node.hidden = !command;
    this.#dialog.querySelector(".download").hidden = chosen.format !== "mcap" || !command;
    this.#showCount(chosen);
  }
}
