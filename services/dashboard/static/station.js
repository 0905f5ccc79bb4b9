// The station's page: one live link feeds the panels; a panel that is out of sight is not sent.

import { CameraPanel } from "./cameras.js";
import { css, OrbitCanvas } from "./canvas.js";
import { DevicesPanel } from "./devices.js";
import { attempt, button, cell, element, find, levelBadge, say, setText, showChildren, showRows, why } from "./dom.js";
import { age } from "./format.js";
import { drawScale, HandCanvas, readTaxels, showLegend } from "./hands.js";
import { Freshness, LiveLink } from "./live.js";
import { readPoses, scene } from "./poses.js";
import { RecorderPanel } from "./recorder.js";
import { ask, pagePath, post } from "./requests.js";
import { FollowLines } from "./sounds.js";
import { PADS } from "./taxels.js";
import { onTheme } from "./theme.js";

function showServices(services) {
  showChildren(find("service_list"), services.map((service) => element("li", { title: service.message },
    levelBadge(service.level), element("span", {}, service.name.replaceAll("_", " ")),
    service.level === "OK" ? null : element("span", { class: "quiet" }, service.message))));
}

const CONSENT = new Map([[true, "consent given"], [false, "no consent"]]);

function takeRow(take) {
  return element("tr", {},
    cell([take.kind, why(take.domain)], "quiet"),
    cell([element("a", { href: pagePath(`/episodes/${take.kind}/${encodeURIComponent(take.name)}`) }, take.name), why(take.size), why(take.clocks)], "name"),
    cell(take.task), cell([take.operator ?? "–", why(CONSENT.get(take.consent))]), cell(take.outcome));
}

// A take that the store refused waits at the station until somebody has it sent again.
function refusedItem(take, note) {
  const again = async ({ target }) => {
    target.disabled = true;
    await attempt(note, () => post(`/v1/uploads/${encodeURIComponent(take.recording_id)}/retry`));
    target.disabled = false;
  };
  return element("li", {}, element("span", {}, element("strong", {}, take.recording_id), why(take.error)), button("Send again", again));
}

function showTakes({ takes, note: empty, refused }) {
  showRows(find("take_rows"), takes.map(takeRow), 5, empty);
  // Rebuilt only when it changes, so that a click does not fall between two buttons.
  const [list, now] = [find("refused_list"), JSON.stringify(refused)];
  if (list.dataset.shown === now) return;
  list.dataset.shown = now;
  const note = element("li", { class: "note", "data-level": "ERROR", role: "alert" });
  list.replaceChildren(...refused.map((take) => refusedItem(take, note)), ...(refused.length ? [note] : []));
}

const LIST_PERIOD_MS = 250;

// Live hands and poses in space, and the state of each tracker.
class PoseView {
  constructor(bones) {
    this.view = new OrbitCanvas(find("pose_canvas"), { paint: () => this.paint() });
    this.request = this.view.request;
    Object.assign(this, { bones, streams: [], note: "waiting for poses", listed: { text: "", at_ms: 0 } });
  }

  update(streams) {
    this.streams = streams;
    this.note = streams.length === 0 ? "This station has no trackers." : "";
    this.showList();
    this.request();
  }

  clear(reason) {
    this.update(this.streams.map((stream) => ({ ...stream, age_s: null, values: new Float32Array(0) })));
    this.note = reason;
  }

  // Age and state of each stream: four times a second, and at once when a state changes.
  showList() {
    const text = this.streams.map(({ name, values }) => `${name} ${values.length > 0}`).join();
    const now_ms = performance.now();
    if (text === this.listed.text && now_ms - this.listed.at_ms < LIST_PERIOD_MS) return;
    this.listed = { text, at_ms: now_ms };
    showChildren(find("pose_list"), this.streams.map(({ name, age_s, values }) => element("li", { "data-stream": name },
      levelBadge(values.length > 0 ? "OK" : "STALE"),
      element("span", {}, name.replaceAll("_", " ")),
      element("span", { class: "quiet" }, age_s === null ? "no data" : age(age_s)))));
  }

  paint() {
    const pen = this.view;
    const { bodies, hands } = scene(this.streams);
    pen.begin([...bodies.map(({ T_world_body: T }) => [T[3], T[7], T[11]]), ...hands.flatMap((hand) => hand.points_world)]);
    for (const { name, T_world_body } of bodies) pen.body(name, T_world_body);
    for (const { side, placed, points_world } of hands) {
      const colour = css(`--hand_${side}`);
      pen.style(colour, 3, placed ? [] : [5, 5]);
      for (const [parent, node] of this.bones) pen.line(points_world[parent], points_world[node]);
      points_world.forEach((point) => pen.dot(point, colour, 2.6));
      if (!placed) pen.label(`${side} hand, wrist not tracked`, points_world[0], colour);
    }
    if (this.note) pen.note(this.note);
  }
}

const heatmap = await (await ask("/v1/heatmap")).json();
const hands = Object.fromEntries(["left", "right"].map((side) => [side, new HandCanvas(find(`hand_${side}`), textsOf(side), side, heatmap)]));

function textsOf(side) {
  const forces = find(`hand_${side}_forces`);
  forces.replaceChildren(...PADS.map((pad) => element("div", {}, element("dt", {}, pad), element("dd", {}, "–"))));
  return { summary: find(`hand_${side}_text`), forces, taxel: find(`hand_${side}_taxel`) };
}

const poses = new PoseView(heatmap.bones);
const cameras = new CameraPanel(find("cameras"), find("camera_row"), find("camera_larger"));
const recorder = new RecorderPanel(find("recorder"));
const following = new FollowLines(recorder.sounds);
const devices = new DevicesPanel();
drawScale(find("scale"), heatmap);
setText(find("scale_end"), `${heatmap.full_scale_kpa} kPa`);

// Nothing of what moves stays on the page for longer than this after its last update.
const STALE_MS = 800;
const clearTouch = (reason) => Object.values(hands).forEach((hand) => hand.clear(reason));
const fresh = {
  station: new Freshness(STALE_MS, () => showNoStation("The dashboard sends no updates: what you saw is old.")),
  taxels: new Freshness(STALE_MS, () => clearTouch("no updates")),
  poses: new Freshness(STALE_MS, () => poses.clear("no updates")),
  cameras: new Freshness(STALE_MS, () => cameras.show([])),
};

function showNoStation(note) {
  showStation({ level: "STALE", summary: "no updates", note, note_level: "ERROR", reachable: false, host: null, causes: [], streams: [],
    recorder: { state: "unknown", actions: [], elapsed_s: null, problems: [], level: "STALE" } });
}

// Marks of taxels, and the age of each glove's tare.
function showGloves(gloves) {
  const counts = {};
  for (const [side, hand] of Object.entries(hands)) {
    const glove = gloves[side];
    if (glove) hand.use(glove.layout);
    hand.mark(glove?.taxels ?? {});
    for (const [state, taxels] of Object.entries(glove?.taxels ?? {})) counts[state] = (counts[state] ?? 0) + taxels.length;
    setText(find(`hand_${side}_tare`), glove ? `tared ${glove.tare_age_s === null ? "at an unknown time" : `${age(glove.tare_age_s)} ago`}` : "");
  }
  showLegend(find("taxel_legend"), counts);
}

function showStation(station) {
  say(find("overall"), station.level, station.level);
  setText(find("summary"), station.summary);
  find("summary").title = station.summary;
  devices.show(station);
  recorder.show(station.recorder, station.level);
  showGloves(station.gloves ?? {});
  following.show(station.following ?? {}, station.recorder.state === "recording");
}

const topics = {
  station: (station) => {
    // The view of a station that answers changes every time, by the ages of its samples.
    if (station.streams.length > 0) fresh.station.note();
    else fresh.station.stop();
    showStation(station);
  },
  trends: (trends) => devices.showTrends(trends),
  services: showServices,
  takes: showTakes,
  last_take: (take) => recorder.showLast(take),
  cameras: (shown) => {
    if (shown.length > 0) fresh.cameras.note();
    cameras.show(shown);
  },
  taxels_lost: clearTouch,
  poses_lost: (reason) => poses.clear(reason),
};

const link = new LiveLink({
  topics,
  // State of station and last take is wanted wherever the page is scrolled; the camera panel is hidden until one exists.
  view: ["station", "trends", "cameras", "last_take"],
  onBinary: (buffer) => {
    const taxels = readTaxels(buffer);
    if (taxels) {
      fresh.taxels.note();
      hands[taxels.side].update(taxels.pressures_kpa);
    }
    const streams = readPoses(buffer);
    if (streams) {
      fresh.poses.note();
      poses.update(streams);
    }
  },
  onLost: () => {
    fresh.station.stop();
    showNoStation("No link to the dashboard: what you see is old.");
    clearTouch("no link");
    poses.clear("no link");
    cameras.show([]);
  },
});

const observer = new IntersectionObserver((entries) => {
  for (const entry of entries) link.show(entry.target.dataset.view, entry.isIntersecting);
});
for (const section of document.querySelectorAll("[data-view]")) {
  if (!["station", "cameras"].includes(section.dataset.view)) observer.observe(section);
}
onTheme(() => [...Object.values(hands), poses].forEach((picture) => picture.request()));
