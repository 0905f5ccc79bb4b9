// A hand's taxel map at the playhead, with the sample's own time. Raw counts have no scale of their own:
// full colour is the largest count of the first seconds.

import { element, setText } from "../dom.js";
import { HandCanvas } from "../hands.js";
import { secondsText, stampOf } from "./times.js";

const SCALE_NS = 30e9;

export class TouchPane {
  constructor(track, side, heatmap) {
    this.track = track;
    this.heatmap = heatmap;
    this.side = side;
    this.isRaw = track.stream.unit !== "kPa";
    const canvas = element("canvas", { class: "hand", role: "img", "aria-label": `taxels of ${track.stream.name}, seen from the palm` });
    this.text = element("span", { class: "quiet" });
    this.time = element("time", { class: "own_time" });
    this.root = element("figure", { class: "touch_pane", "data-stream": track.stream.name, "data-state": "loading" },
      canvas, element("figcaption", {}, element("span", { class: "name" }, track.stream.name), this.time, this.text));
    // Raw counts have a text of their own.
    this.hand = new HandCanvas(canvas, this.isRaw ? {} : { summary: this.text }, side, { ...heatmap });
    this.hand.mark({ unmeasured: track.stream.unmeasured_taxels });
    this.shown_ns = null;
    if (this.isRaw) this.scaleRaw();
  }

  async scaleRaw() {
    const { stream, item } = this.track;
    if (stream.first_ns === null) return;
    const span = { start_ns: stream.first_ns, stop_ns: Math.min(stream.last_ns + 1, stream.first_ns + SCALE_NS) };
    const found = await item.signals([`${stream.name}.max`], span, 1).catch(() => null);
    const [largest] = found?.get(`${stream.name}.max`).high ?? [];
    if (!(largest > 0)) return;
    Object.assign(this.hand.heatmap, { full_scale_kpa: largest, contact_kpa: 0 });
    if (this.shown_ns !== null) this.drawHand();
  }

  // The taxels among the cells of a raw sample.
  taxels(values) {
    const cells = this.heatmap.raw_cells[this.side];
    return values.length === this.heatmap.num_raw_cells ? Float32Array.from(cells, (cell) => values[cell]) : Float32Array.from(values);
  }

  drawHand() {
    this.hand.draw();
    if (this.isRaw) setText(this.text, `largest ${Math.max(...this.hand.pressures_kpa)} ${this.track.stream.unit}`);
  }

  clear(words) {
    this.hand.clear(words);
    setText(this.text, words);
  }

  show(t_ns) {
    const found = this.track.sampleAt(t_ns);
    if (found.state === "sample") {
      this.root.dataset.state = "shown";
      if (found.t_ns === this.shown_ns) return;
      this.shown_ns = found.t_ns;
      this.hand.pressures_kpa = this.taxels(found.values);
      this.drawHand();
      setText(this.time, `${secondsText(Math.round(found.t_ns / 1e5) * 1e5)} s`);
      this.root.dataset.stamp = stampOf(found.t_ns, this.track.item.zero);
    } else if (found.state === "none") {
      this.root.dataset.state = "none";
      this.shown_ns = null;
      this.clear("no sample");
      setText(this.time, "");
      delete this.root.dataset.stamp;
    } else {
      this.root.dataset.state = found.error ? "failed" : "loading";
      if (found.error) this.clear(found.error.message);
    }
  }
}
