// The audit log: newest entries first, of one action or person if asked for.

import { get } from "../catalog/api.js";
import { date } from "../dates.js";
import { element, repeat, say } from "../dom.js";
import { plural } from "../format.js";
import { result } from "./figures.js";

const PERIOD_MS = 5000;
const STEP = 50;
const MAX_SHOWN = 1000;

function row(entry) {
  const words = result(entry.status);
  return element("tr", { title: entry.request_id ? `request ${entry.request_id}` : null },
    element("td", {}, date(entry.at)),
    element("td", { class: "name" }, entry.person),
    element("td", {}, entry.action),
    element("td", { class: "target", title: entry.target }, element("span", {}, entry.target || "–")),
    element("td", { class: words === "done" ? null : "not_done" }, words),
    element("td", { class: "quiet" }, entry.client || "–"));
}

function notes({ folder, num_damaged, num_lost, no_used_tokens }) {
  const found = [folder === null
    ? "Kept in memory only, and lost when the dashboard ends: set DEXTOUCH_DASHBOARD_AUDIT_FOLDER to keep it."
    : `Kept in ${folder}.`];
  if (num_damaged) found.push(`${plural(num_damaged, "damaged line")} skipped.`);
  if (num_lost) found.push(`${plural(num_lost, "entry").replace("entrys", "entries")} could not be written since the dashboard started; see its log.`);
  if (no_used_tokens) found.push(`Without tokens that stations used: ${no_used_tokens}.`);
  return found.join(" ");
}

export class AuditTable {
  constructor(find) {
    this.find = find;
    this.limit = STEP;
    this.asked = 0;
    this.people = new Set();
    this.filters = find("audit_filters");
  }

  start() {
    const again = () => {
      this.limit = STEP;
      this.refresh();
    };
    this.filters.addEventListener("input", again);
    this.filters.addEventListener("submit", (event) => {
      event.preventDefault();
      again();
    });
    this.find("audit_more").addEventListener("click", () => {
      this.limit = Math.min(this.limit + STEP, MAX_SHOWN);
      this.refresh();
    });
    repeat(() => this.refresh(), PERIOD_MS);
  }

  async refresh() {
    const number = ++this.asked;
    const query = new URLSearchParams({ limit: this.limit });
    for (const [name, value] of new FormData(this.filters)) if (value) query.set(name, value);
    try {
      const page = await get(`/v1/audit?${query}`);
      if (number === this.asked) this.show(page);
    } catch (error) {
      say(this.find("audit_note"), `Audit log: ${error.message}`, "ERROR");
    }
  }

  show(page) {
    say(this.find("audit_note"), notes(page), page.num_lost ? "ERROR" : page.num_damaged || page.folder === null ? "WARN" : null);
    const actions = this.filters.elements.action;
    if (actions.options.length === 1) actions.append(...page.actions.map((one) => element("option", {}, one)));
    const known = this.people.size;
    page.people.forEach((one) => this.people.add(one));
    if (this.people.size !== known) this.find("people").replaceChildren(...[...this.people].sort().map((one) => element("option", { value: one })));
    const now = JSON.stringify(page.entries);
    if (this.shown !== now) {
      this.shown = now;
      const empty = element("tr", {}, element("td", { colspan: 6, class: "free" }, "No entries."));
      this.find("audit_rows").replaceChildren(...(page.entries.length ? page.entries.map(row) : [empty]));
    }
    this.find("audit_more").hidden = !page.has_more || this.limit >= MAX_SHOWN;
  }
}
