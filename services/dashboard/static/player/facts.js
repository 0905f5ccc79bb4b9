// Facts about the item: what was done by whom, how it ended, its quality, clocks, lineage and exports.

import { downloadControl } from "../catalog/export.js";
import { nodeItem } from "../catalog/items.js";
import { button, commandLine, element, levelBadge, table } from "../dom.js";
import { date, number, plural } from "../format.js";
import { apply, IDENTITY, matrixOfPose, TIPS } from "../poses.js";
import { fetchFacts } from "./item.js";
import { lastAtOrBefore } from "./tracks.js";

const SECOND_NS = 1e9;
const READ_NS = 30e9;
const MAX_BINS = 4000;
const STAGES = [
  ["Retargeting", /^retargeting_/],
  ["Motion", /(_peak_speed_m_s|_jerk_p95_m_s3|^static_share)$/],
  ["Objects", /_(share_seen|reprojection_px)$/],
  ["Synchronization", /^(num_steps_|origin_after_start_ns|coverage|duration_s)/],
  ["Recorded streams", /./],
];
const UNITS = [[/_m_s3$/, "m/s³"], [/_m_s$/, "m/s"], [/_mm$/, "mm"], [/_ms$/, "ms"], [/_ns$/, "s", 1e-9], [/_px$/, "px"], [/_ppm$/, "ppm"], [/_s$/, "s"]];
const ACTION_PLACES = { left: [0, 1, 2], right: [9, 10, 11] };

// [stage, [{name, text, value}]] of the stages that have figures.
export function byStage(quality) {
  const found = new Map(STAGES.map(([stage]) => [stage, []]));
  for (const [name, value] of Object.entries(quality)) {
    const [stage] = STAGES.find(([, form]) => form.test(name));
    found.get(stage).push({ name, ...inWords(name, value) });
  }
  return [...found].filter(([, figures]) => figures.length);
}

function inWords(name, value) {
  const isShare = /(^|_)(share|coverage)/.test(name);
  const [form, unit, factor = 1] = isShare ? [/$^/, "%", 100] : UNITS.find(([suffix]) => suffix.test(name)) ?? [/$^/, ""];
  const text = name.replace(form, "").replace(/^retargeting_/, "").replace(/_p95$/, ", 95th percentile").replace(/^num_|_num_/, (found) => (found === "num_" ? "" : ": ")).replaceAll("_", " ");
  return { text, value: `${Number((factor * value).toPrecision(4))}${unit ? ` ${unit}` : ""}` };
}

// The second around a time, as [from_ns, to_ns] inside the item.
function secondAround(item, t_ns) {
  const from_ns = Math.max(Math.min(t_ns - SECOND_NS / 2, item.stop_ns - SECOND_NS), item.start_ns);
  return [from_ns, Math.min(from_ns + SECOND_NS, item.stop_ns)];
}

function longest(spans) {
  return spans.reduce((worst, span) => (worst && worst[1] - worst[0] >= span[1] - span[0] ? worst : span), null);
}

// Differences of this order between neighbours, of columns of equal length; the largest of their norms.
export function largestChange(columns, order) {
  let changes = columns.map((column) => Array.from(column));
  for (let k = 0; k < order; k += 1) changes = changes.map((column) => column.slice(1).map((value, index) => value - column[index]));
  const norms = changes[0].map((_, index) => Math.hypot(...changes.map((column) => column[index])));
  const worst = norms.reduce((best, norm, index) => (norm > (norms[best] ?? -1) ? index : best), -1);
  return worst < 0 ? null : worst + order / 2;
}

// Where signals change most, as a time: bins are as long as the stream's period, or as short as the store allows.
async function changing(item, names, order) {
  const { first_ns, last_ns, num_samples } = item.streams.get(names[0].split(".")[0]);
  const points = Math.min(num_samples, MAX_BINS);
  const found = await item.signals(names, { start_ns: first_ns, stop_ns: last_ns + 1 }, points);
  const bin = largestChange(names.map((name) => found.get(name).high), order);
  return bin === null ? null : first_ns + ((bin + 0.5) * (last_ns + 1 - first_ns)) / points;
}

// A function that finds the worst second of a figure as a span; null for a figure without a place in time.
export function worstOf(item, name) {
  const around = (t_ns) => (t_ns === null ? null : secondAround(item, t_ns));
  const action = item.streams.get("action");
  const interval = /^(.+)_interval_ms$/.exec(name);
  if (interval && item.streams.get(interval[1])?.num_samples > 1) return async () => around(await changing(item, [`${interval[1]}.interval_ms`], 0));
  const [, side, figure] = /^wrist_(left|right)_(peak_speed|jerk_p95)_/.exec(name) ?? [];
  if (side && action?.num_samples) return async () => around(await changing(item, ACTION_PLACES[side].map((place) => `action.${place}`), figure === "jerk_p95" ? 3 : 1));
  if (name === "num_steps_interpolated" && action?.interpolated.length) return async () => longest(action.interpolated.map(({ span_ns }) => span_ns));
  const stream = [...item.streams.values()].find((one) => name.startsWith(`${one.name}_num_`));
  if (/_num_(gaps|incomplete|clock_steps)$/.test(name) && stream?.gaps_ns.length) return async () => longest(stream.gaps_ns);
  const tips = /^retargeting_(left|right)_tip_error/.exec(name);
  if (tips && action?.num_samples && item.streams.get(`keypoints_${tips[1]}`)?.num_samples) return async () => around(await farthestTips(item, tips[1]));
  return null;
}

// When a fingertip of the robot's hand is farthest from the measured one.
async function farthestTips(item, side) {
  const keypoints = item.streams.get(`keypoints_${side}`);
  const parent = item.streams.get(keypoints.frame ?? `wrist_${side}`);
  let worst = { distance_m: -1, t_ns: null };
  for (let start_ns = keypoints.first_ns; start_ns <= keypoints.last_ns; start_ns += READ_NS) {
    const span = { start_ns, stop_ns: start_ns + READ_NS };
    const read = await Promise.all([item.robotHands("measured", span), item.samples(keypoints.name, span), parent && item.samples(parent.name, span)]);
    const [robot, hand, wrist] = read.map((found) => found?.value);
    robot.t_ns.forEach((t_ns, step) => {
      const [at, pose] = [lastAtOrBefore(hand.t_ns, t_ns), wrist ? lastAtOrBefore(wrist.t_ns, t_ns) : 0];
      if (at < 0 || pose < 0) return;
      const T = wrist ? matrixOfPose(wrist.values.subarray(7 * pose, 7 * pose + 7)) : IDENTITY;
      if (!T) return;
      TIPS.forEach((node, finger) => {
        const measured = apply(T, hand.values.subarray(75 * at + 3 * node, 75 * at + 3 * node + 3));
        const tip = 3 * (4 * (5 * step + finger) + 3);
        const distance_m = Math.hypot(...measured.map((value, axis) => value - robot.arrays[`${side}_points_world_m`].values[tip + axis]));
        if (distance_m > worst.distance_m) worst = { distance_m, t_ns };
      });
    });
  }
  return worst.t_ns;
}

const OPEN_FIGURES = 6;
const OUTCOMES = { true: ["OK", "success"], false: ["ERROR", "failure"], null: ["STALE", "not judged"] };

export function outcomeBadge(success) {
  return levelBadge(...OUTCOMES[String(success)]);
}

function rows(pairs) {
  return element("dl", { class: "facts" }, ...pairs.filter(([, value]) => value !== null && value !== undefined && value !== "")
    .flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value instanceof Node ? value : String(value))]));
}

const framed = (heads, lines) => element("div", { class: "table_frame" }, table(heads, lines));
const block = (title, ...children) => element("section", { class: "fact_block" }, element("h3", {}, title), ...children);
const wideBlock = (title, ...children) => element("section", { class: "fact_block wide" }, element("h3", {}, title), ...children);

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
  return lines.length ? wideBlock("Clocks", framed(heads, lines)) : null;
}

// A button that goes to the second in which a figure is worst.
function worstButton(find, text, onSpan) {
  if (!find) return null;
  const go = async ({ target }) => {
    target.disabled = true;
    const span = await find().catch((error) => error);
    target.disabled = false;
    if (Array.isArray(span)) onSpan(span);
    else target.replaceWith(element("span", { class: "quiet" }, span?.message ?? "nowhere"));
  };
  return button("Go", go, { class: "plain", "aria-label": `Go to the worst second of ${text}` });
}

function quality(item, figures, onSpan) {
  const stages = byStage(figures ?? {});
  if (!stages.length) return null;
  return wideBlock("Quality", element("div", { class: "stages" }, ...stages.map(([stage, found]) => element("details", { open: found.length <= OPEN_FIGURES ? "" : null },
    element("summary", {}, `${stage}: ${plural(found.length, "figure")}`),
    framed(["Figure", "Value", "Worst second"], found.map(({ name, text, value }) => [element("span", { title: name }, text), value, worstButton(worstOf(item, name), text, onSpan)]))))));
}

function ledger(entries) {
  const lines = (entries ?? []).map((entry) => [entry.stream, entry.event, String(entry.count)]);
  return lines.length ? block("Faults noticed at the station", framed(["Stream", "Event", "Count"], lines)) : null;
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
