// The page System: services, disks and queues, jobs, station keys, and the audit log.

import { attempt, cell, commandLine, element, find, KeyedRows, levelBadge, newestOnly, onClick, onSubmit, repeat, say, setText, showRows, twoStep, why, wideRow } from "../dom.js";
import { age, bytes, count, date, number, plural } from "../format.js";
import { LiveLink } from "../live.js";
import { get, getIfServed, pagePath, post } from "../requests.js";
import { progress, studyProgress } from "../study_tables.js";

const LEVELS = { ready: "OK", waiting: "WARN", down: "ERROR" };
// A slower change of a disk is not the recorder's.
const STILL_BYTES_PER_S = 1000;
const figure = (text, title = null) => cell(text, "number", { title });

// "measuring" while the disk has been watched for too short a time.
function filling(rate) {
  if (rate === null) return "measuring";
  if (Math.abs(rate) < STILL_BYTES_PER_S) return "no change";
  return rate > 0 ? `${bytes(rate)}/s` : `${bytes(-rate)}/s freed`;
}

// How long acknowledged takes stay in a spool.
function retention({ keep_s, keep_bytes }) {
  if (keep_s === 0 || keep_bytes === 0) return "removed once the store has them";
  const days = keep_s / 86_400;
  const most = keep_bytes === null ? "" : `, at most ${bytes(keep_bytes)}`;
  return `kept for ${Number(days.toFixed(1))} ${days === 1 ? "day" : "days"}${most}`;
}

function versionCell({ version }, own) {
  if (version === null || version === own) return cell(version ?? "–");
  return cell([element("span", { class: "differs" }, version), why(`dashboard ${own}`)]);
}

function serviceRow(service, own) {
  const mark = service.shares_process ? " *" : "";
  const reason = service.state === "waiting" ? `waiting for ${service.waiting_for.join(", ")}` : service.problem;
  return element("tr", { "data-service": service.name, "data-level": service.state === "ready" ? null : LEVELS[service.state] },
    cell(levelBadge(LEVELS[service.state], service.state)), cell([service.name, why(reason)], "name"), versionCell(service, own), figure(age(service.uptime_s)),
    figure(service.latency_s === null ? "–" : number(1000 * service.latency_s, service.latency_s < 0.01 ? 1 : 0, "ms")),
    figure(service.memory_bytes === null ? "–" : `${bytes(service.memory_bytes)}${mark}`),
    figure(service.cpu_ratio === null ? "–" : `${number(100 * service.cpu_ratio, 0, "%")}${mark}`),
    cell(service.address, "address"));
}

function diskRow(disk) {
  return element("tr", { "data-level": disk.level === "OK" ? null : disk.level },
    cell(levelBadge(disk.level, disk.level === "OK" ? "OK" : "low")), cell(disk.name, "name"), figure(bytes(disk.free_bytes)),
    figure(filling(disk.fill_bytes_per_s), disk.fill_bytes_per_s === null ? null : `over the last ${age(disk.span_s)}`), figure(age(disk.left_s)));
}

function spoolRow(spool) {
  return element("tr", {}, cell(spool.name, "name"),
    figure(`${bytes(spool.waiting_bytes)} in ${plural(spool.num_waiting, "take")}`),
    figure(`${bytes(spool.uploaded_bytes)} in ${plural(spool.num_uploaded, "take")}`), cell(retention(spool)));
}

function queueRow(queue) {
  return element("tr", { "data-level": queue.level === "OK" ? null : queue.level },
    cell(levelBadge(queue.level)), cell(queue.name, "name"), cell(queue.place), figure(String(queue.count)), figure(count(queue.limit)));
}

function show({ version, services, disks, spools, queues }) {
  const ready = services.filter((one) => one.state === "ready").length;
  setText(find("summary"), `${ready} of ${plural(services.length, "service")} ready`);
  setText(find("own_version"), `dashboard ${version}`);
  showRows(find("service_rows"), services.map((one) => serviceRow(one, version)), 8, "This dashboard was started without the address of any service.");
  find("shared_process").hidden = !services.some((one) => one.shares_process);
  const store = services.find((one) => one.name === "episode store");
  if (store) stations.suggest(store.address);
  showRows(find("disk_rows"), disks.map(diskRow), 5, "No service measures its disk.");
  find("spools").hidden = !spools.length;
  showRows(find("spool_rows"), spools.map(spoolRow), 4, "");
  showRows(find("queue_rows"), queues.map(queueRow), 5, "No service has a queue.");
}

const MAX_RUNNING = 20;
const MAX_WAITING = 10;
const NO_ALIGNMENTS = { alignments: [], num_matching: 0 };

// Alignments that wait or run, which can be cancelled in two steps, and studies that run.
class Jobs {
  constructor() {
    this.note = find("jobs_note");
    this.rows = new KeyedRows(find("job_rows"));
    this.alignments = [];
    this.numHidden = 0;
    this.studies = [];
    repeat(() => this.refresh(), 2000);
  }

  showStudies({ studies }) {
    this.studies = studies.filter((one) => one.is_running);
    this.draw();
  }

  refresh() {
    return attempt(this.note, async () => {
      const [running, waiting] = await Promise.all([
        getIfServed(`/v1/alignment/alignments?state=running&limit=${MAX_RUNNING}`, NO_ALIGNMENTS),
        getIfServed(`/v1/alignment/alignments?state=waiting&limit=${MAX_WAITING}`, NO_ALIGNMENTS)]);
      this.alignments = [...running.alignments, ...waiting.alignments];
      this.numHidden = running.num_matching + waiting.num_matching - this.alignments.length;
      this.draw();
    }, "Alignments: ");
  }

  async cancel(job) {
    const path = `/v1/alignment/alignments/${encodeURIComponent(job.alignment_id)}`;
    try {
      await post(`${path}/cancel`, {});
      say(this.note, `Alignment of ${job.recording_id} cancelled.`);
    } catch (error) {
      const now = await get(path).catch(() => null);
      say(this.note, `Alignment of ${job.recording_id}: ${error.message}${now ? ` (it is ${now.state})` : ""}`, "ERROR");
    }
    await this.refresh();
  }

  row(key, cells) {
    return this.rows.row(key, () => element("tr", { "data-job": key }, ...cells()));
  }

  alignmentRow(job) {
    const row = this.row(`alignment ${job.alignment_id}`, () => [cell(""),
      cell(element("a", { href: pagePath(`/episodes/recording/${encodeURIComponent(job.recording_id)}`) }, job.recording_id), "name"),
      cell("alignment"), cell(""), cell("", "free"), figure(""), cell(twoStep("Cancel", () => this.cancel(job)), "act")]);
    const running = job.state === "running";
    row.cells[0].replaceChildren(levelBadge(running ? "OK" : "STALE", job.state));
    row.cells[3].replaceChildren(running ? progress(job.progress, 1, "progress", `${Math.round(100 * job.progress)} %`) : "–");
    setText(row.cells[4], [job.stage, job.stream, job.attempts > 1 ? `attempt ${job.attempts}` : null].filter(Boolean).join(" · "));
    setText(row.cells[5], age(job.eta_s));
    return row;
  }

  studyRow(study) {
    const row = this.row(`study ${study.name}`, () => [cell(levelBadge("OK", "running")),
      cell([element("a", { href: pagePath(`/studies/${encodeURIComponent(study.name)}`) }, study.title || study.name),
        why(study.title && study.title !== study.name ? study.name : "")], "name"),
      cell("study"), cell(""), cell("", "free"), figure("–"), cell("")]);
    row.cells[3].replaceChildren(studyProgress(study));
    setText(row.cells[4], study.num_failed ? `${study.num_failed} rollouts failed` : "");
    return row;
  }

  draw() {
    const more = this.numHidden > 0 ? [wideRow(7, `and ${this.numHidden} more alignments`)] : [];
    const rows = [...this.alignments.map((job) => this.alignmentRow(job)), ...this.studies.map((one) => this.studyRow(one)), ...more];
    this.rows.show(rows);
    find("no_jobs").hidden = rows.length > 0;
  }
}

const ENROLMENTS = "/v1/episode_store/enrolments";
const KEY_LEVELS = { waiting: "WARN", expired: "STALE", enrolled: "OK", revoked: "STALE" };
const NEEDLESS = "The store has no API keys, so stations upload without one. Set api_keys before enrolling stations.";

// The newest enrolment of each station, by name.
function newestOf(enrolments) {
  const newest = new Map();
  for (const one of enrolments) {
    const known = newest.get(one.station);
    if (!known || Date.parse(one.requested_at) > Date.parse(known.requested_at)) newest.set(one.station, one);
  }
  return [...newest.values()].sort((a, b) => (a.station < b.station ? -1 : 1));
}

// Station keys: enrolled stations, a one-time token for another one, and revocation in two steps.
class StationKeys {
  constructor() {
    this.form = find("enrol_form");
    this.note = find("stations_note");
    this.rows = new KeyedRows(find("station_rows"));
    this.command = commandLine("", element("code", { id: "enrol_command" }));
    this.waitsFor = null;
    find("enrol_text").after(this.command.node);
    onClick({ enrol_open: () => this.open(this.form.hidden), enrol_done: () => this.forget() });
    onSubmit(this.form, () => this.enrol());
    repeat(() => this.refresh(), 5000);
  }

  // Under which address the dashboard reaches the store, which may be another one for stations.
  suggest(address) {
    const field = this.form.elements.url;
    if (field.value === "") field.value = address;
  }

  open(isOpen) {
    this.form.hidden = !isOpen;
    find("enrol_open").setAttribute("aria-expanded", String(isOpen));
    if (isOpen) this.form.elements.station.focus();
  }

  async enrol() {
    const station = this.form.elements.station.value.trim();
    const url = this.form.elements.url.value.trim().replace(/\/+$/, "");
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    await attempt(this.note, async () => {
      const { token, expires_at } = await post(ENROLMENTS, { station });
      this.waitsFor = station;
      setText(find("enrol_text"), `Run this on ${station} before ${date(expires_at, "minute")}. It works once, and is not shown again.`);
      this.command.show(`dextouch station enrol ${url} ${token}`);
      find("enrol_shown").hidden = false;
      this.open(false);
      this.form.elements.station.value = "";
      say(this.note, "");
    }, `Station ${station}: `);
    submit.disabled = false;
    await this.refresh();
  }

  forget() {
    find("enrol_shown").hidden = true;
    this.command.show("");
    this.waitsFor = null;
  }

  async revoke(station) {
    await attempt(this.note, async () => {
      await post(`${ENROLMENTS}/${encodeURIComponent(station)}/revoke`, {});
      say(this.note, `The key of ${station} is revoked: its takes wait in its spool.`);
    }, `Station ${station}: `);
    await this.refresh();
  }

  async refresh() {
    const listed = await attempt(this.note, async () => (await getIfServed(ENROLMENTS, null)) ?? {}, "Station keys: ");
    find("stations").hidden = listed !== null && !listed.enrolments;
    if (listed?.enrolments) this.show(listed);
  }

  show({ enrolments, needs_key }) {
    const newest = newestOf(enrolments);
    find("enrol_open").disabled = !needs_key;
    find("no_stations").hidden = newest.length > 0;
    setText(find("no_stations"), needs_key ? "No station is enrolled." : NEEDLESS);
    const used = newest.find((one) => one.station === this.waitsFor && one.state === "enrolled");
    if (used) {
      this.forget();
      say(this.note, `${used.station} is enrolled.`);
    }
    this.rows.show(newest.map((one) => this.row(one)));
  }

  row(one) {
    const isValid = ["waiting", "enrolled"].includes(one.state);
    return this.rows.row(JSON.stringify(one), () => element("tr", { "data-station": one.station },
      cell(levelBadge(KEY_LEVELS[one.state], one.state)), cell(one.station, "name"), cell(date(one.revoked_at ?? one.enrolled_at ?? one.requested_at)),
      cell(one.enrolled_from || "–", "address"), cell(one.requested_by), cell(one.revoked_by || "–"),
      cell(isValid ? twoStep("Revoke", () => this.revoke(one.station)) : null, "act")));
  }
}

const AUDIT_STEP = 50;
const MAX_AUDITED = 1000;

function auditRow(entry) {
  const result = entry.status < 400 ? "done" : `${entry.status < 500 ? "refused" : "failed"} (${entry.status})`;
  return element("tr", { title: entry.request_id ? `request ${entry.request_id}` : null },
    cell(date(entry.at)), cell(entry.person, "name"), cell(entry.action), cell(element("span", {}, entry.target || "–"), "target", { title: entry.target }),
    cell(result, result === "done" ? null : "not_done"), cell(entry.client || "–", "quiet"));
}

function auditNotes({ folder, num_damaged, num_lost, no_used_tokens }) {
  const found = [folder === null ? "Kept in memory only, and lost when the dashboard ends: set DEXTOUCH_DASHBOARD_AUDIT_FOLDER to keep it." : `Kept in ${folder}.`];
  if (num_damaged) found.push(`${plural(num_damaged, "damaged line")} skipped.`);
  if (num_lost) found.push(`${num_lost} ${num_lost === 1 ? "entry" : "entries"} could not be written since the dashboard started; see its log.`);
  if (no_used_tokens) found.push(`Without tokens that stations used: ${no_used_tokens}.`);
  return found.join(" ");
}

// The audit log: newest entries first, of one action or person if asked for.
class AuditTable {
  constructor() {
    this.limit = AUDIT_STEP;
    this.people = new Set();
    this.filters = find("audit_filters");
    this.refresh = newestOnly(() => this.read(), (page) => this.show(page), (error) => say(find("audit_note"), `Audit log: ${error.message}`, "ERROR"));
    const again = (limit) => {
      this.limit = Math.min(limit, MAX_AUDITED);
      this.refresh();
    };
    this.filters.addEventListener("input", () => again(AUDIT_STEP));
    onSubmit(this.filters, () => again(AUDIT_STEP));
    onClick({ audit_more: () => again(this.limit + AUDIT_STEP) });
    repeat(this.refresh, 5000);
  }

  read() {
    const query = new URLSearchParams({ limit: this.limit });
    for (const [name, value] of new FormData(this.filters)) if (value) query.set(name, value);
    return get(`/v1/audit?${query}`);
  }

  show(page) {
    say(find("audit_note"), auditNotes(page), page.num_lost ? "ERROR" : page.num_damaged || page.folder === null ? "WARN" : null);
    const actions = this.filters.elements.action;
    if (actions.options.length === 1) actions.append(...page.actions.map((one) => element("option", {}, one)));
    const known = this.people.size;
    page.people.forEach((one) => this.people.add(one));
    if (this.people.size !== known) find("people").replaceChildren(...[...this.people].sort().map((one) => element("option", { value: one })));
    showRows(find("audit_rows"), page.entries.map(auditRow), 6, "No entries.");
    find("audit_more").hidden = !page.has_more || this.limit >= MAX_AUDITED;
  }
}

const stations = new StationKeys();
const jobs = new Jobs();
new LiveLink({ topics: { system: show, studies: (studies) => jobs.showStudies(studies) } });
new AuditTable();
