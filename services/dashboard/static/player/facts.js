// Facts about the item: what was done by whom, how it ended, its quality, clocks, lineage and exports.

import { downloadControl } from "../catalog/download.js";
import { nodeItem } from "../catalog/lineage.js";
import { commandLine } from "../command.js";
import { date } from "../dates.js";
import { element, levelBadge } from "../dom.js";
import { number, plural } from "../format.js";
import { byStage, worstOf } from "./figures.js";
import { fetchFacts } from "./item.js";

const OPEN_FIGURES = 6;
const OUTCOMES = { true: ["OK", "success"], false: ["ERROR", "failure"], null: ["STALE", "not judged"] };

export function outcomeBadge(success) {
  return levelBadge(...OUTCOMES[String(success)]);
}

function rows(pairs) {
  return element("dl", { class: "facts" }, ...pairs.filter(([, value]) => value !== null && value !== undefined && value !== "")
    .flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value instanceof Node ? value : String(value))]));
}

function table(heads, lines) {
  return element("div", { class: "table_frame" }, element("table", {},
    element("thead", {}, element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head)))),
    element("tbody", {}, ...lines.map((line) => element("tr", {}, ...line.map((cell) => element("td", {}, cell)))))));
}

function block(title, ...children) {
  return element("section", { class: "fact_block" }, element("h3", {}, title), ...children);
}

function wideBlock(title, ...children) {
  const found = block(title, ...children);
  found.classList.add("wide");
  return found;
}

function about(item, trace_id) {
  const { about: facts } = item;
  return block("About", rows([
    ["Task", facts.task],
    ["Instruction", facts.instruction],
    ["Operator", facts.operator],
    ["Outcome", outcomeBadge(facts.success)],
    ["Domain, origin", `${facts.domain}, ${facts.origin}`],
    ["Station", facts.station],
    ["Time", facts.at ? date(facts.at) : null],
    ["Length", `${((item.stop_ns - item.start_ns) / 1e9).toFixed(3)} s`],
    ["Model steps", facts.num_steps ? `${facts.num_steps} at ${facts.model_rate_hz} Hz` : null],
    ["Trace", trace_id ? element("a", { class: "trace", href: `/episodes?text=${trace_id}` }, trace_id) : null],
    ["Not recorded", facts.absent.join(", ")],
    ["Incomplete", facts.recovered ? "yes: its writer did not finish it" : null],
  ]));
}

function clocks(item, reports, onSpan) {
  const worst = ({ stream }) => worstButton(item.streams.has(stream) ? worstOf(item, `${stream}_interval_ms`) : null, `the clock of ${stream}`, onSpan);
  const lines = reports.map((report) => [report.stream, report.method ?? "unknown", number(report.skew_ppm, 2), number(report.latency_ms, 2),
    number(report.residual_rms_ms, 3), `${report.num_dropped} of ${report.num_samples}`, report.warnings.join(", ") || "none", worst(report)]);
  const heads = ["Stream", "Stamps by", "Skew ppm", "Latency ms", "Residual ms", "Dropped", "Warnings", "Longest interval"];
  if (!lines.length) return null;
  return wideBlock("Clocks", table(heads, lines));
}

// A button that goes to the second in which a figure is worst.
function worstButton(find, text, onSpan) {
  if (!find) return null;
  const button = element("button", { type: "button", class: "plain", "aria-label": `Go to the worst second of ${text}` }, "Go");
  button.addEventListener("click", async () => {
    button.disabled = true;
    const span = await find().catch((error) => error);
    button.disabled = false;
    if (Array.isArray(span)) onSpan(span);
    else button.replaceWith(element("span", { class: "quiet" }, span?.message ?? "nowhere"));
  });
  return button;
}

function quality(item, figures, onSpan) {
  const stages = byStage(figures ?? {});
  if (!stages.length) return null;
  return wideBlock("Quality", element("div", { class: "stages" }, ...stages.map(([stage, found]) => element("details", { open: found.length <= OPEN_FIGURES ? "" : null },
    element("summary", {}, `${stage}: ${plural(found.length, "figure")}`),
    table(["Figure", "Value", "Worst second"], found.map(({ name, text, value }) => [element("span", { title: name }, text), value, worstButton(worstOf(item, name), text, onSpan)]))))));
}

function ledger(entries) {
  const lines = (entries ?? []).map((entry) => [entry.stream, entry.event, String(entry.count)]);
  return lines.length ? block("Faults noticed at the station", table(["Stream", "Event", "Count"], lines)) : null;
}

const RELATIONS = { source: "made from", product: "used in" };

function lineage(nodes) {
  const others = nodes.filter((node) => node.relation !== "self");
  if (!others.length) return null;
  return block("Lineage", element("ul", { class: "lineage" }, ...others.map((node) => nodeItem(node, RELATIONS[node.relation]))));
}

function exports({ kind, id }) {
  const of_kind = kind === "recording" ? "--kind recording " : "";
  const command = (format) => `dextouch export --format ${format} ${of_kind}${id} --to ${id}.${format}`;
  return wideBlock("Open in other tools",
    element("p", {}, "Foxglove: download or export, open the file, and import ", element("a", { href: "/static/player/foxglove_layout.json", download: "dextouch_layout.json" }, "this layout"), "."),
    downloadControl(() => ({ items: [{ kind, id }] })),
    commandLine(command("mcap")).node,
    element("p", {}, "Rerun: export and open; the file contains its layout."),
    commandLine(`${command("rrd")} && rerun ${id}.rrd`).node);
}

// `onSpan` shows a span of time, [from_ns, to_ns].
export async function showFacts(root, item, onSpan) {
  const { kind, id } = item.about;
  const path = `${kind}s/${encodeURIComponent(id)}${kind === "recording" ? "/attributes" : ""}`;
  const [detail, found] = await Promise.all([
    fetchFacts(`/${path}`).catch(() => ({})),
    fetchFacts(`/catalog/lineage/${item.path}`).catch(() => ({ nodes: [] })),
  ]);
  const attributes = detail.attributes ?? detail;
  const blocks = [about(item, attributes.trace_id), lineage(found.nodes), clocks(item, attributes.clocks ?? [], onSpan), quality(item, attributes.quality, onSpan), ledger(attributes.ledger), exports(item.about)];
  root.replaceChildren(...blocks.filter((one) => one));
}
