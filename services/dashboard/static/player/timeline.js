// The timeline: a ruler, a lane for each stream with its gaps, and the playhead; scrubbed by mouse and
// keys, zoomed by wheel and buttons. `range` is the visible part, in nanoseconds of the player.

import { button, element, keep, kept, setText } from "../dom.js";
import { clockText, secondsText, ticks, tickText } from "./times.js";

const SHORTEST_RANGE_NS = 1e7;
const PX_PER_TICK = 110;
// Where a lane a stream would hide what is played.
const SMALL = matchMedia("(max-height: 900px), (max-width: 1020px)");

function place(node, from, to) {
  node.style.left = `${100 * from}%`;
  node.style.width = `${100 * Math.max(to - from, 0)}%`;
}

// "3 gaps, longest 1.20 s", or what else there is to say about a stream.
function gapText(stream) {
  if (!stream.num_samples) return "no samples";
  if (stream.interpolated.length) return `${stream.interpolated.length} interpolated`;
  if (!stream.num_gaps) return `${stream.num_samples} samples`;
  const longest_s = Math.max(...stream.gaps_ns.map(([from_ns, to_ns]) => to_ns - from_ns)) / 1e9;
  return `${stream.num_gaps} gap${stream.num_gaps > 1 ? "s" : ""} ≤ ${longest_s.toFixed(2)} s`;
}

// All streams as one lane, which stands for theirs while they are folded.
function together(streams) {
  const known = streams.filter(({ first_ns }) => first_ns !== null);
  const sum = (name) => streams.reduce((total, stream) => total + stream[name], 0);
  return { name: "", label: `${streams.length} streams`, members: streams, num_samples: sum("num_samples"), num_gaps: sum("num_gaps"), gaps_ns: streams.flatMap(({ gaps_ns }) => gaps_ns), interpolated: streams.flatMap(({ interpolated }) => interpolated),
    first_ns: known.length ? Math.min(...known.map(({ first_ns }) => first_ns)) : null, last_ns: Math.max(...known.map(({ last_ns }) => last_ns)) };
}

export class Timeline {
  constructor(root, item, { range, onSeek, onRange }) {
    Object.assign(this, { root, onSeek, onRange, marks: [] });
    this.range = this.bounds = [item.start_ns, Math.max(item.stop_ns, item.start_ns + SHORTEST_RANGE_NS)];
    this.ruler = element("div", { class: "ruler" });
    this.head = element("div", { class: "playhead" });
    this.over = element("div", { class: "over" }, this.head);
    const streams = [...item.streams.values()];
    this.lanes = [together(streams), ...streams].map((stream) => this.lane(stream));
    const turn = () => {
      const isFolded = !root.classList.contains("folded");
      this.setFolded(isFolded);
      keep("timeline", isFolded ? "folded" : "open");
    };
    this.fold = button([], turn, { class: "plain lane_name", title: "One line for all streams, or one for each" });
    // Beside the slider: a slider cannot have controls in it.
    root.before(this.fold);
    root.append(element("div", { class: "lane ruler_row" }, element("span"), this.ruler, element("span", { class: "lane_note" })),
      element("div", { class: "lanes" }, ...this.lanes.map(({ row }) => row)), this.over);
    this.listen();
    this.setFolded((kept("timeline") ?? (SMALL.matches ? "folded" : "open")) === "folded");
    this.setRange(range ?? this.bounds);
  }

  lane(stream) {
    const extent = element("i", { class: "extent" });
    const mark = (gap_ns, kind, words) => ({ gap_ns, node: element("i", { class: kind, title: `${words} from ${secondsText(gap_ns[0])} to ${secondsText(gap_ns[1])} s` }) });
    const gaps = (stream.members ?? [stream]).flatMap((one) => [...one.gaps_ns.map((gap_ns) => mark(gap_ns, "gap", `${one.name}: no sample`)),
      ...one.interpolated.map(({ part, span_ns }) => mark(span_ns, "gap interpolated", `${part}: interpolated`))]);
    const shown = stream.num_gaps > gaps.length ? `; the ${gaps.length} longest are marked` : "";
    const note = element("span", { class: "lane_note", title: `${stream.num_samples} samples, ${stream.num_gaps} gaps${shown}` }, gapText(stream));
    const row = element("div", { class: "lane", "data-stream": stream.name },
      element("span", { class: "lane_name", title: stream.name }, stream.label ?? stream.name),
      element("span", { class: "lane_bar" }, extent, ...gaps.map(({ node }) => node)), note);
    return { stream, row, extent, gaps };
  }

  setFolded(isFolded) {
    this.root.classList.toggle("folded", isFolded);
    setText(this.fold, `${isFolded ? "▸" : "▾"} Streams`);
    this.fold.setAttribute("aria-expanded", String(!isFolded));
  }

  listen() {
    const at = (event) => {
      const box = this.over.getBoundingClientRect();
      return this.range[0] + ((event.clientX - box.left) / Math.max(box.width, 1)) * (this.range[1] - this.range[0]);
    };
    this.over.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.over.setPointerCapture(event.pointerId);
      this.root.focus({ preventScroll: true });
      this.onSeek(at(event));
    });
    this.over.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) this.onSeek(at(event));
    });
    // Elsewhere the wheel scrolls the lanes.
    this.over.addEventListener("wheel", (event) => {
      const isPan = event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY);
      event.preventDefault();
      if (isPan) this.pan((0.001 * (event.deltaX || event.deltaY)) * (this.range[1] - this.range[0]));
      else this.zoom(Math.exp(0.0015 * event.deltaY), at(event));
    }, { passive: false });
  }

  zoom(factor, about_ns) {
    const [from_ns, to_ns] = this.range;
    const about = Math.min(Math.max(about_ns, from_ns), to_ns);
    this.setRange([about - (about - from_ns) * factor, about + (to_ns - about) * factor]);
  }

  pan(by_ns) {
    const length_ns = this.range[1] - this.range[0];
    const from_ns = Math.min(Math.max(this.range[0] + by_ns, this.bounds[0]), this.bounds[1] - length_ns);
    this.setRange([from_ns, from_ns + length_ns]);
  }

  fit() {
    this.setRange(this.bounds);
  }

  get isZoomed() {
    return this.range[0] > this.bounds[0] || this.range[1] < this.bounds[1];
  }

  setRange([from_ns, to_ns]) {
    const [first_ns, last_ns] = this.bounds;
    const missing_ns = Math.max(0, SHORTEST_RANGE_NS - (to_ns - from_ns)) / 2;
    this.range = [Math.round(Math.max(from_ns - missing_ns, first_ns)), Math.round(Math.min(to_ns + missing_ns, last_ns))];
    this.draw();
    this.onRange(this.range);
  }

  // Keep the playhead in view while it moves.
  follow(t_ns) {
    const [from_ns, to_ns] = this.range;
    if (t_ns < from_ns) this.pan(t_ns - to_ns + 0.1 * (to_ns - from_ns));
    else if (t_ns > to_ns) this.pan(t_ns - from_ns - 0.1 * (to_ns - from_ns));
  }

  share(t_ns) {
    return Math.min(Math.max((t_ns - this.range[0]) / (this.range[1] - this.range[0]), 0), 1);
  }

  // Marks {span_ns, node} over all lanes, in place of the earlier ones.
  setMarks(marks) {
    for (const { node } of this.marks) node.remove();
    this.marks = marks;
    this.over.prepend(...marks.map(({ node }) => node));
    this.draw();
  }

  draw() {
    for (const { span_ns, node } of this.marks) {
      node.hidden = span_ns[1] < this.range[0] || span_ns[0] > this.range[1];
      place(node, ...span_ns.map((t_ns) => this.share(t_ns)));
    }
    const marks = ticks(...this.range, Math.max(2, (this.ruler.clientWidth || 800) / PX_PER_TICK));
    this.ruler.replaceChildren(...marks.at_ns.map((t_ns) => {
      const mark = element("span", {}, tickText(t_ns, marks.step_ns));
      mark.style.left = `${100 * this.share(t_ns)}%`;
      return mark;
    }));
    for (const { stream, extent, gaps } of this.lanes) {
      if (stream.first_ns !== null) place(extent, this.share(stream.first_ns), this.share(stream.last_ns));
      for (const { gap_ns, node } of gaps) place(node, ...gap_ns.map((t_ns) => this.share(t_ns)));
    }
    if (this.t_ns !== undefined) this.show(this.t_ns);
  }

  show(t_ns) {
    this.t_ns = t_ns;
    this.head.hidden = t_ns < this.range[0] || t_ns > this.range[1];
    this.head.style.left = `${100 * this.share(t_ns)}%`;
    const [first_ns, last_ns] = this.bounds;
    for (const [name, value] of [["valuemin", first_ns], ["valuemax", last_ns], ["valuenow", t_ns]]) this.root.setAttribute(`aria-${name}`, (value / 1e9).toFixed(3));
    this.root.setAttribute("aria-valuetext", clockText(t_ns));
  }

  note(node) {
    setText(node, this.isZoomed ? `${secondsText(this.range[0])} – ${secondsText(this.range[1])} s` : "");
  }
}
