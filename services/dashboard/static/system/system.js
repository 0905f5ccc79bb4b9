// The page System: state of services, disks and queues; jobs and the audit log have files of their own.

import { element, find, levelBadge, setText, showChildren, why } from "../dom.js";
import { age, bytes, count, plural } from "../format.js";
import { LiveLink } from "../live.js";
import { AuditTable } from "./audit_table.js";
import { cpu, filling, latency, retention } from "./figures.js";
import { Jobs } from "./jobs.js";
import { StationKeys } from "./stations.js";

const LEVELS = { ready: "OK", waiting: "WARN", down: "ERROR" };

function number(text) {
  return element("td", { class: "number" }, text);
}

function versionCell(service, own) {
  if (service.version === null) return element("td", {}, "–");
  if (service.version === own) return element("td", {}, service.version);
  return element("td", {}, element("span", { class: "differs" }, service.version), why(`dashboard ${own}`));
}

function serviceRow(service, own) {
  const mark = service.shares_process ? " *" : "";
  const reason = service.state === "waiting" ? `waiting for ${service.waiting_for.join(", ")}` : service.problem;
  return element("tr", { "data-service": service.name, "data-level": service.state === "ready" ? null : LEVELS[service.state] },
    element("td", {}, levelBadge(LEVELS[service.state], service.state)),
    element("td", { class: "name" }, service.name, why(reason)),
    versionCell(service, own),
    number(age(service.uptime_s)), number(latency(service.latency_s)),
    number(service.memory_bytes === null ? "–" : `${bytes(service.memory_bytes)}${mark}`),
    number(service.cpu_ratio === null ? "–" : `${cpu(service.cpu_ratio)}${mark}`),
    element("td", { class: "address" }, service.address));
}

function diskRow(disk) {
  return element("tr", { "data-level": disk.level === "OK" ? null : disk.level },
    element("td", {}, levelBadge(disk.level, disk.level === "OK" ? "OK" : "low")),
    element("td", { class: "name" }, disk.name), number(bytes(disk.free_bytes)),
    element("td", { class: "number", title: disk.fill_bytes_per_s === null ? null : `over the last ${age(disk.span_s)}` }, filling(disk.fill_bytes_per_s)),
    number(age(disk.left_s)));
}

function spoolRow(spool) {
  return element("tr", {}, element("td", { class: "name" }, spool.name),
    number(`${bytes(spool.waiting_bytes)} in ${plural(spool.num_waiting, "take")}`),
    number(`${bytes(spool.uploaded_bytes)} in ${plural(spool.num_uploaded, "take")}`),
    element("td", {}, retention(spool)));
}

function queueRow(queue) {
  return element("tr", { "data-level": queue.level === "OK" ? null : queue.level },
    element("td", {}, levelBadge(queue.level)),
    element("td", { class: "name" }, queue.name), element("td", {}, queue.place), number(String(queue.count)), number(count(queue.limit)));
}

function fill(id, rows, columns, empty) {
  showChildren(find(id), (rows.length ? rows
    : [element("tr", {}, element("td", { colspan: columns, class: "free" }, empty))]));
}

function show({ version, services, disks, spools, queues }) {
  const ready = services.filter((one) => one.state === "ready").length;
  setText(find("summary"), `${ready} of ${plural(services.length, "service")} ready`);
  setText(find("own_version"), `dashboard ${version}`);
  fill("service_rows", services.map((one) => serviceRow(one, version)), 8, "This dashboard was started without the address of any service.");
  find("shared_process").hidden = !services.some((one) => one.shares_process);
  const store = services.find((one) => one.name === "episode store");
  if (store) stations.suggest(store.address);
  fill("disk_rows", disks.map(diskRow), 5, "No service measures its disk.");
  find("spools").hidden = !spools.length;
  fill("spool_rows", spools.map(spoolRow), 4, "");
  fill("queue_rows", queues.map(queueRow), 5, "No service has a queue.");
}

const stations = new StationKeys(find);
const jobs = new Jobs(find("job_rows"), find("jobs_note"), find("no_jobs"));
const link = new LiveLink({
  onTopic: (topic, data) => {
    if (topic === "system") show(data);
    if (topic === "studies") jobs.showStudies(data.studies);
  },
});
link.show("system", true);
link.show("studies", true);
jobs.start();
stations.start();
new AuditTable(find).start();
