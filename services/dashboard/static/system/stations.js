// Station keys: enrolled stations, a one-time token for another one, and revocation in two steps.

import { getIfServed, post } from "../catalog/api.js";
import { date } from "../dates.js";
import { element, levelBadge, repeat, say, setText } from "../dom.js";
import { newestOf, since } from "./figures.js";
import { twoStep } from "./two_step.js";

const PERIOD_MS = 5000;
const PATH = "/v1/episode_store/enrolments";
const LEVELS = { waiting: "WARN", expired: "STALE", enrolled: "OK", revoked: "STALE" };
const NEEDLESS = "The store has no API keys, so stations upload without one. Set api_keys before enrolling stations.";

export class StationKeys {
  constructor(find) {
    this.find = find;
    this.form = find("enrol_form");
    this.rows = new Map();
    this.waitsFor = null;
  }

  start() {
    this.find("enrol_open").addEventListener("click", () => this.open(this.form.hidden));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.enrol();
    });
    this.find("enrol_copy").addEventListener("click", () => this.copy());
    this.find("enrol_done").addEventListener("click", () => this.forget());
    repeat(() => this.refresh(), PERIOD_MS);
  }

  // Under which address the dashboard reaches the store, which may be another one for stations.
  suggest(address) {
    const field = this.form.elements.url;
    if (field.value === "") field.value = address;
  }

  open(isOpen) {
    this.form.hidden = !isOpen;
    this.find("enrol_open").setAttribute("aria-expanded", String(isOpen));
    if (isOpen) this.form.elements.station.focus();
  }

  async enrol() {
    const station = this.form.elements.station.value.trim();
    const url = this.form.elements.url.value.trim().replace(/\/+$/, "");
    const button = this.form.querySelector("[type=submit]");
    button.disabled = true;
    try {
      const { token, expires_at } = await post(PATH, { station });
      this.waitsFor = station;
      setText(this.find("enrol_text"), `Run this on ${station} before ${date(expires_at, "minute")}. `
        + "It works once, and is not shown again.");
      setText(this.find("enrol_command"), `dextouch station enrol ${url} ${token}`);
      setText(this.find("enrol_copy"), "Copy");
      this.find("enrol_shown").hidden = false;
      this.open(false);
      this.form.elements.station.value = "";
      say(this.find("stations_note"), "");
    } catch (error) {
      say(this.find("stations_note"), `Station ${station}: ${error.message}`, "ERROR");
    } finally {
      button.disabled = false;
    }
    await this.refresh();
  }

  // Without TLS browsers offer no clipboard: then the command is selected, to be copied by hand.
  async copy() {
    const command = this.find("enrol_command");
    getSelection().selectAllChildren(command);
    try {
      await navigator.clipboard.writeText(command.textContent);
      setText(this.find("enrol_copy"), "Copied");
    } catch {
      setText(this.find("enrol_copy"), "Press Ctrl C");
    }
  }

  forget() {
    this.find("enrol_shown").hidden = true;
    setText(this.find("enrol_command"), "");
    setText(this.find("enrol_copy"), "Copy");
    this.waitsFor = null;
  }

  async revoke(station) {
    try {
      await post(`${PATH}/${encodeURIComponent(station)}/revoke`, {});
      say(this.find("stations_note"), `The key of ${station} is revoked: its takes wait in its spool.`);
    } catch (error) {
      say(this.find("stations_note"), `Station ${station}: ${error.message}`, "ERROR");
    }
    await this.refresh();
  }

  async refresh() {
    try {
      const listed = await getIfServed(PATH, null);
      this.find("stations").hidden = listed === null;
      if (listed !== null) this.show(listed);
    } catch (error) {
      this.find("stations").hidden = false;
      say(this.find("stations_note"), `Station keys: ${error.message}`, "ERROR");
    }
  }

  show({ enrolments, needs_key }) {
    const newest = newestOf(enrolments);
    this.find("enrol_open").disabled = !needs_key;
    this.find("no_stations").hidden = newest.length > 0;
    setText(this.find("no_stations"), needs_key ? "No station is enrolled." : NEEDLESS);
    const used = newest.find((one) => one.station === this.waitsFor && one.state === "enrolled");
    if (used) {
      this.forget();
      say(this.find("stations_note"), `${used.station} is enrolled.`);
    }
    const rows = newest.map((one) => this.row(one));
    for (const [key, row] of this.rows) if (!rows.includes(row)) this.rows.delete(key);
    const body = this.find("station_rows");
    if (rows.length !== body.rows.length || rows.some((row, index) => row !== body.rows[index])) body.replaceChildren(...rows);
  }

  // Rows stay while nothing changes, so that a click never falls between two buttons.
  row(one) {
    const key = JSON.stringify(one);
    if (!this.rows.has(key)) {
      const isValid = ["waiting", "enrolled"].includes(one.state);
      this.rows.set(key, element("tr", { "data-station": one.station },
        element("td", {}, levelBadge(LEVELS[one.state], one.state)),
        element("td", { class: "name" }, one.station),
        element("td", {}, date(since(one))),
        element("td", { class: "address" }, one.enrolled_from || "–"),
        element("td", {}, one.requested_by),
        element("td", {}, one.revoked_by || "–"),
        element("td", { class: "act" }, isValid ? twoStep("Revoke", () => this.revoke(one.station)) : null)));
    }
    return this.rows.get(key);
  }
}
