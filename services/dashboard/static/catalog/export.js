// Dialog that exports what is selected or filtered: the command, and a download of MCAP files.

import { commandLine } from "../command.js";
import { element, setText } from "../dom.js";
import { plural } from "../format.js";
import { get } from "./api.js";
import { downloadControl } from "./download.js";
import { exportCommand, itemsOfKind, kindsOf } from "./export_command.js";
import { PAGE_ROWS, storeQuery } from "./query.js";

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
  #asked = 0;

  constructor(dialog) {
    this.#dialog = dialog;
    this.#form = dialog.querySelector("[data-choices]");
    const download = downloadControl(() => this.#listed());
    dialog.querySelector("[data-body]").replaceChildren(this.#command.node,
      element("p", { class: "quiet" }, "The command runs on the computer of the store; with another data folder than its default, add --store. Items that were rejected in review are left out, unless they are selected or filtered."),
      download);
    this.#form.addEventListener("input", () => this.#show());
    this.#form.addEventListener("submit", (event) => event.preventDefault());
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

  async #show() {
    const { kind, format } = this.#form.elements;
    const kinds = kindsOf(format.value);
    for (const option of kind.options) option.disabled = !kinds.includes(option.value);
    if (!kinds.includes(kind.value)) [kind.value] = kinds;
    const chosen = this.#chosen();
    const command = exportCommand({ ...chosen, filters: this.#query.filters });
    this.#command.show(command);
    this.#command.node.hidden = !command;
    this.#dialog.querySelector(".download").hidden = chosen.format !== "mcap" || !command;
    const number = ++this.#asked;
    const note = this.#dialog.querySelector("[data-count]");
    try {
      const count = chosen.items?.length ?? (await pageOf({ ...this.#query, limit: PAGE_ROWS }, chosen.kind, 1)).num_matching;
      if (number === this.#asked) setText(note, count ? plural(count, chosen.kind) : `no ${chosen.kind}`);
    } catch (error) {
      if (number === this.#asked) setText(note, error.message);
    }
  }
}
