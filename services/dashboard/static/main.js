// The page: one live link feeds the panels; a panel that is out of sight is not sent.

import { CameraPanel } from "./cameras.js";
import { css } from "./canvas.js";
import { DevicesPanel } from "./devices.js";
import { element, find, setText } from "./dom.js";
import { age } from "./format.js";
import { FollowLines } from "./following.js";
import { Freshness } from "./freshness.js";
import { drawScale, HandCanvas, readTaxels } from "./hands.js";
import { showRefused, showServices, showTakes } from "./lists.js";
import { LiveLink } from "./live.js";
import { PoseView } from "./pose_view.js";
import { readPoses } from "./poses.js";
import { RecorderPanel } from "./recorder.js";
import { ask } from "./session.js";
import { showLegend } from "./taxel_marks.js";
import { PADS } from "./taxels.js";
import { onTheme } from "./theme.js";

const heatmap = await (await ask("/v1/heatmap")).json();
const hands = {
  left: new HandCanvas(find("hand_left"), textsOf("left"), "left", heatmap),
  right: new HandCanvas(find("hand_right"), textsOf("right"), "right", heatmap),
};

function textsOf(side) {
  const forces = find(`hand_${side}_forces`);
  forces.replaceChildren(...PADS.map((pad) => element("div", {}, element("dt", {}, pad), element("dd", {}, "–"))));
  return { summary: find(`hand_${side}_text`), forces, taxel: find(`hand_${side}_taxel`) };
}

const poses = new PoseView(find("pose_canvas"), find("pose_list"), heatmap.bones);
const cameras = new CameraPanel(find("cameras"), find("camera_row"), find("camera_larger"));
const recorder = new RecorderPanel(find("recorder"));
const following = new FollowLines(find, recorder.sounds);
const devices = new DevicesPanel(find("devices"));
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
  showLegend(find("taxel_legend"), counts, css);
}

function showStation(station) {
  const overall = find("overall");
  overall.dataset.level = station.level;
  setText(overall, station.level);
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
  services: (services) => showServices(find("service_list"), services),
  takes: (takes) => {
    showTakes(find("take_rows"), takes);
    showRefused(find("refused_list"), takes.refused);
  },
  last_take: (take) => recorder.showLast(take),
  cameras: (shown) => {
    if (shown.length > 0) fresh.cameras.note();
    cameras.show(shown);
  },
  taxels_lost: clearTouch,
  poses_lost: (reason) => poses.clear(reason),
};

const link = new LiveLink({
  onTopic: (topic, data) => topics[topic]?.(data),
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
  onState: (connected) => {
    if (!connected) {
      fresh.station.stop();
      showNoStation("No link to the dashboard: what you see is old.");
      clearTouch("no link");
      poses.clear("no link");
      cameras.show([]);
    }
  },
});

// State of station and last take is wanted wherever the page is scrolled; the camera panel is hidden until one exists.
link.show("station", true);
link.show("trends", true);
link.show("cameras", true);
link.show("last_take", true);
const observer = new IntersectionObserver((entries) => {
  for (const entry of entries) link.show(entry.target.dataset.view, entry.isIntersecting);
});
for (const section of document.querySelectorAll("[data-view]")) {
  if (!["station", "cameras"].includes(section.dataset.view)) observer.observe(section);
}
onTheme(() => [...Object.values(hands), poses].forEach((picture) => picture.request()));
