// The player of a recording or an episode: panes, timeline, plots and keys around one playhead.

import { beforeNextFrame } from "../canvas.js";
import { element, find, isModified, onClick, onSubmit, setText } from "../dom.js";
import { drawScale } from "../hands.js";
import { ask, pagePath } from "../requests.js";
import { withLayout } from "../taxels.js";
import { onTheme } from "../theme.js";
import { Editing } from "./editing.js";
import { outcomeBadge, showFacts } from "./facts.js";
import { Item } from "./item.js";
import { ACTION_SIZE, ActionPane, CameraPane, SpacePane, TouchPane } from "./panes.js";
import { componentWords, isSignal, Plots, signalParts } from "./plots.js";
import { Timeline } from "./timeline.js";
import { clockText, formatState, parseState, PlayClock, secondsText, SPEEDS } from "./times.js";
import { FetchQueue, ImageTrack, RobotTrack, SampleTrack } from "./tracks.js";

const BUDGET_BYTES = 96e6;
// While paused, little is loaded ahead: the store is free for the next place on the timeline.
const AHEAD_S = 2;
const AHEAD_PAUSED_S = 0.3;
const STEP_NS = 1e9;
const URL_MS = 400;
const RETRY_MS = 1000;
const ACTIONS = { measured: "action", commanded: "action_commanded" };

// A box that is checked while its value is in a set, or is not (`isIn`).
function bind(box, set, isIn, onChange) {
  box.checked = set.has(box.value) === isIn;
  box.addEventListener("change", () => {
    set[box.checked === isIn ? "add" : "delete"](box.value);
    onChange();
  });
}

class Player {
  constructor(item, heatmap, state) {
    this.item = item;
    this.heatmap = heatmap;
    this.clock = new PlayClock(item.start_ns, item.stop_ns);
    this.clock.speed = SPEEDS.includes(state.speed) ? state.speed : 1;
    this.clock.seek(state.at_ns ?? item.begin_ns);
    this.queue = new FetchQueue({ budget_bytes: BUDGET_BYTES, onLoaded: () => this.request() });
    this.request = beforeNextFrame((now_ms) => this.frame(now_ms));
    this.hidden = new Set(state.hidden);
    this.makePanes(state);
    this.plots = new Plots(find("plots"), item, {
      onSeek: (t_ns) => this.seek(t_ns),
      onRemove: (name) => this.setSignals(this.signals.filter((one) => one !== name)),
      rawName: (raw, name) => this.rawName(raw, name),
    });
    this.timeline = new Timeline(find("timeline"), item, {
      range: state.zoom_ns,
      onSeek: (t_ns) => this.seek(t_ns),
      onRange: (range) => this.ranged(range),
    });
    this.plots.setRange(this.timeline.range);
    const wanted = state.signals ?? this.usualSignals();
    this.setSignals(wanted.filter((name) => isSignal(name, item.streams)));
    this.listen();
    if (state.raw) this.compareRaw();
  }

  makePanes(state) {
    const { item, queue } = this;
    const samples = (stream) => new SampleTrack(queue, item, stream);
    const cameras = item.ofKind("image");
    this.cameras = cameras.map((stream) => new CameraPane(new ImageTrack(queue, item, stream), () => this.enlarge(stream.name)));
    this.shown = new Set(state.cameras ?? cameras.map((stream) => stream.name));
    find("cameras").hidden = !cameras.length;
    find("camera_row").append(...this.cameras.map((pane) => pane.root));
    find("camera_choice").append(...cameras.map((stream) => this.choice(stream.name, this.shown, () => this.chosen())));

    const hands = item.ofKind("tactile").filter((stream) => ["left", "right"].includes(stream.side) && this.isHand(stream));
    this.touch = hands.map((stream) => new TouchPane(samples(stream), stream.side, withLayout(this.heatmap, stream.layout)));
    find("touch").hidden = !hands.length;
    find("hands").append(...this.touch.map((pane) => pane.root));

    const actions = Object.entries(ACTIONS).filter(([, name]) => item.streams.get(name)?.size === ACTION_SIZE);
    const action_tracks = Object.fromEntries(actions.map(([kind, name]) => [kind, samples(item.streams.get(name))]));
    find("action").hidden = !action_tracks.measured;
    this.action = action_tracks.measured ? new ActionPane(find("action"), action_tracks, (name) => this.addSignal(name)) : null;

    const isHuman = item.about.domain === "human" && item.about.origin === "twin";
    const robots = item.about.kind === "episode" && !isHuman ? actions.map(([kind, name]) => new RobotTrack(queue, item, item.streams.get(name), kind)) : [];
    const poses = item.ofKind("pose").filter((stream) => stream.shape.at(-1) === 7).map(samples);
    const keypoints = item.ofKind("keypoints").filter((stream) => stream.shape.at(-1) === 3).map(samples);
    find("space").hidden = !(poses.length + keypoints.length + robots.length);
    this.space = new SpacePane(find("space"), { poses, keypoints, robots }, { hidden: this.hidden, view: state.view, bones: this.heatmap.bones, onChange: () => this.noteUrl() });
    for (const box of find("layers").querySelectorAll("input")) {
      const has = box.value === "measured_hands" ? keypoints.length : robots.some((track) => track.action_kind === box.value);
      box.closest("label").hidden = !has;
    }
    this.tracks = [...this.touch.map((pane) => pane.track), ...Object.values(action_tracks), ...poses, ...keypoints, ...robots];
    this.chosen();
  }

  choice(name, set, onChange) {
    const box = element("input", { type: "checkbox", value: name });
    bind(box, set, true, onChange);
    return element("label", { class: "check" }, box, name);
  }

  chosen() {
    for (const pane of this.cameras) pane.root.hidden = !this.shown.has(pane.track.name);
    const lead = this.stepTrack();
    setText(find("step_note"), lead ? `← → ${lead.stream.name}` : "");
    this.noteUrl();
    this.request();
  }

  enlarge(name) {
    for (const pane of this.cameras) pane.root.classList.toggle("large", pane.track.name === name && !pane.root.classList.contains("large"));
    this.request();
  }

  get visibleCameras() {
    return this.cameras.filter((pane) => this.shown.has(pane.track.name));
  }

  // The stream whose samples the arrow keys step through.
  stepTrack() {
    return this.visibleCameras[0]?.track ?? this.tracks[0];
  }

  usualSignals() {
    const names = this.item.ofKind("tactile").map((stream) => stream.name);
    if (this.item.streams.has("action")) names.push("action.0", "action.9");
    return names.length ? names.slice(0, 4) : [...this.item.streams.values()].slice(0, 2).map((stream) => (stream.kind === "image" ? `${stream.name}.interval_ms` : stream.name));
  }

  // Whether a tactile stream can be drawn as a hand: its taxels, or the raw cells among which they are.
  isHand(stream) {
    const { cells, num_raw_cells } = withLayout(this.heatmap, stream.layout);
    return [cells[stream.side].length, num_raw_cells].includes(stream.size);
  }

  setSignals(names) {
    this.signals = names;
    this.plots.setSignals(names);
    this.noteUrl();
  }

  addSignal(name) {
    if (isSignal(name, this.item.streams) && !this.signals.includes(name)) this.setSignals([...this.signals, name]);
  }

  rawName(raw, name) {
    const { stream, what } = signalParts(name);
    const [ours, theirs] = [this.item.streams.get(stream), raw.streams.get(stream)];
    if (!theirs) return null;
    if (ours.size === theirs.size || !/^\d/.test(what)) return name;
    const { num_raw_cells, raw_cells } = withLayout(this.heatmap, theirs.layout);
    const cells = theirs.size === num_raw_cells ? raw_cells[ours.side] : null;
    return cells && ours.size === cells.length ? `${stream}.${cells[Number(what)]}` : null;
  }

  async compareRaw() {
    const box = find("raw");
    box.checked = true;
    const { item, reason } = await Item.openSource(this.item);
    if (!box.checked) return;
    this.showRaw(item, item ? `raw: ${item.about.id}, by its arrivals` : `no raw signals: ${reason}`);
  }

  showRaw(item, words) {
    setText(find("raw_note"), words);
    this.plots.setRaw(item);
    this.noteUrl();
  }

  listen() {
    onClick({
      play: () => this.toggle(), back: () => this.step(-1), forward: () => this.step(1), copy_link: () => this.copyLink(),
      zoom_in: () => this.timeline.zoom(0.5, this.clock.t_ns), zoom_out: () => this.timeline.zoom(2, this.clock.t_ns), zoom_fit: () => this.timeline.fit(),
    });
    const speed = find("speed");
    speed.append(...SPEEDS.map((one) => element("option", { value: one }, `${one}×`)));
    speed.value = String(this.clock.speed);
    speed.addEventListener("change", () => this.setSpeed(Number(speed.value)));
    const raw = find("raw");
    raw.closest("label").hidden = this.item.about.kind !== "episode";
    raw.addEventListener("change", () => (raw.checked ? this.compareRaw() : this.showRaw(null, "")));
    for (const box of find("layers").querySelectorAll("input")) bind(box, this.hidden, false, () => { this.noteUrl(); this.request(); });
    const stream = find("signal_stream");
    stream.append(...[...this.item.streams.keys()].map((name) => element("option", { value: name }, name)));
    stream.addEventListener("change", () => this.listValues(stream.value));
    this.listValues(stream.value);
    onSubmit(find("signal_form"), () => this.submitSignal(stream.value, find("signal_value").value.trim()));
    document.addEventListener("keydown", (event) => this.pressed(event));
    document.addEventListener("pointerup", (event) => event.target.closest?.("button")?.blur());
    setInterval(() => {
      if (this.queue.failures.size) this.request();
    }, RETRY_MS);
  }

  // Values that can be plotted of a stream, by name.
  listValues(stream) {
    const { components, kind } = this.item.streams.get(stream);
    this.named = components.map((name) => componentWords(name).text);
    find("signal_value").value = "";
    find("signal_values").replaceChildren(...[...this.named, ...(kind === "image" ? [] : ["sum", "max"]), "interval"].map((value) => element("option", { value })));
  }

  submitSignal(stream, value) {
    const place = this.named.indexOf(value);
    const what = place >= 0 ? String(place) : value === "interval" ? "interval_ms" : value;
    const name = what && what !== "sum" ? `${stream}.${what}` : stream;
    const isKnown = isSignal(name, this.item.streams);
    const { size, kind } = this.item.streams.get(stream);
    const choices = kind === "image" ? "interval" : `${this.named.length ? "a name of the list, " : ""}sum, max, interval or 0 … ${size - 1}`;
    setText(find("signal_note"), isKnown ? "" : `${stream}: got “${value}”, expected ${choices}`);
    if (isKnown) this.addSignal(name);
  }

  pressed(event) {
    if (isModified(event) || event.target.closest("input:not([type=checkbox]), select, textarea")) return;
    const jumps = { ArrowLeft: -1, ArrowRight: 1 };
    const acts = {
      " ": () => this.toggle(),
      Home: () => this.seek(this.clock.start_ns),
      End: () => this.seek(this.clock.stop_ns),
      "+": () => this.timeline.zoom(0.5, this.clock.t_ns),
      "-": () => this.timeline.zoom(2, this.clock.t_ns),
      0: () => this.timeline.fit(),
    };
    const act = event.key in jumps
      ? () => (event.shiftKey ? this.seek(this.clock.t_ns + jumps[event.key] * STEP_NS) : this.step(jumps[event.key]))
      : Object.hasOwn(acts, event.key) ? acts[event.key] : null;
    if (!act || (event.key === " " && event.target.closest("button, input, summary"))) return;
    event.preventDefault();
    act();
  }

  toggle() {
    this.clock.toggle();
    this.noteUrl();
    this.request();
  }

  setSpeed(speed) {
    this.clock.speed = speed;
    this.noteUrl();
    this.request();
  }

  seek(t_ns) {
    this.clock.seek(t_ns);
    this.timeline.follow(this.clock.t_ns);
    this.noteUrl();
    this.request();
  }

  // To the next or previous sample of the leading camera; presses during the search are added to it.
  async step(direction) {
    this.clock.pause();
    this.steps = (this.steps ?? 0) + direction;
    if (this.isStepping) return;
    this.isStepping = true;
    try {
      while (this.steps) {
        const one = Math.sign(this.steps);
        this.steps -= one;
        const found_ns = await this.stepTrack()?.neighbour(this.clock.t_ns, one);
        if (found_ns !== null && found_ns !== undefined) this.seek(found_ns);
      }
    } catch (error) {
      setText(find("status"), error.message);
    }
    this.steps = 0;
    this.isStepping = false;
  }

  ranged(range) {
    this.timeline?.note(find("zoom_note"));
    this.plots.setRange(range);
    this.noteUrl();
  }

  start() {
    this.timeline.draw();
    this.timeline.note(find("zoom_note"));
    this.request();
  }

  frame(now_ms) {
    const tracks = [...this.visibleCameras.map((pane) => pane.track), ...this.tracks];
    const isReadyAt = (t_ns) => tracks.every((track) => track.isReadyAt(t_ns));
    for (const pane of this.visibleCameras) pane.chooseSize(this.clock.speed);
    const wasPlaying = this.clock.playing;
    if (this.clock.tick(now_ms, isReadyAt)) this.timeline.follow(this.clock.t_ns);
    const { t_ns, playing } = this.clock;
    for (const pane of [...this.visibleCameras, ...this.touch, this.space, ...(this.action ? [this.action] : [])]) pane.show(t_ns);
    this.timeline.show(t_ns);
    this.plots.show(t_ns);
    setText(find("clock"), clockText(t_ns));
    find("clock").title = `${secondsText(t_ns)} s`;
    setText(find("play_text"), playing ? "Pause" : "Play");
    setText(find("status"), isReadyAt(t_ns) ? "" : "loading");
    this.load(tracks);
    if (playing) this.request();
    if (wasPlaying) this.noteUrl();
  }

  load(tracks) {
    const { t_ns, speed, stop_ns, playing } = this.clock;
    const ahead_s = playing ? AHEAD_S * Math.max(speed, 1) : AHEAD_PAUSED_S;
    const until_ns = Math.min(t_ns + 1e9 * ahead_s, stop_ns);
    const now = tracks.flatMap((track) => track.now(t_ns));
    const ahead = tracks.flatMap((track) => track.ahead(t_ns, until_ns).map((entry, place) => ({ place, entry })));
    ahead.sort((one, other) => one.place - other.place);
    this.queue.want([...now, ...ahead.map(({ entry }) => entry)]);
  }

  // The query that shows this moment elsewhere.
  query() {
    const all = this.cameras.length === this.shown.size;
    return formatState({
      at_ns: this.clock.t_ns,
      cameras: all ? null : this.visibleCameras.map((pane) => pane.track.name),
      signals: this.signals,
      zoom_ns: this.timeline.isZoomed ? this.timeline.range : null,
      view: this.space.view(),
      raw: find("raw").checked,
      hidden: [...this.hidden],
      speed: this.clock.speed,
    });
  }

  // Browsers refuse addresses that change too often.
  noteUrl() {
    if (this.url_timer) return;
    this.url_timer = setTimeout(() => {
      this.url_timer = null;
      history.replaceState(null, "", pagePath(`?${this.query()}`));
    }, URL_MS);
  }

  async copyLink() {
    const link = `${location.origin}${location.pathname}?${this.query()}`;
    try {
      await navigator.clipboard.writeText(link);
      setText(find("status"), "link copied");
    } catch {
      history.replaceState(null, "", link);
      setText(find("status"), "copy the link from the address bar");
    }
  }

  recolour() {
    this.space.draw();
    this.plots.recolour();
    this.action?.draw();
    for (const pane of this.touch) if (pane.shown_ns !== null) pane.drawHand();
  }
}

function showTitle({ about }) {
  document.title = `${about.id} · ${document.title}`;
  setText(find("item_id"), about.id);
  setText(find("item_kind"), about.kind);
  find("outcome").replaceChildren(outcomeBadge(about.success));
  setText(find("instruction"), [about.task, about.instruction].filter((text) => text).join(" · "));
}

async function open() {
  const [, , kind, id] = location.pathname.split("/").map(decodeURIComponent);
  const [item, heatmap] = await Promise.all([Item.open(kind, id), ask("/v1/heatmap").then((answer) => answer.json())]);
  showTitle(item);
  drawScale(find("scale"), heatmap);
  const isRaw = item.ofKind("tactile").some((stream) => stream.unit !== "kPa");
  setText(find("scale_end"), isRaw ? "largest count" : `${heatmap.full_scale_kpa} kPa`);
  const player = new Player(item, heatmap, parseState(location.search));
  const editing = new Editing(player);
  showFacts(find("facts"), item, (span) => {
    editing.select(span);
    player.seek(span[0]);
  });
  return player;
}

let player = null;
onTheme(() => player?.recolour());
try {
  player = await open();
  find("player").hidden = find("deck").hidden = false;
  player.start();
} catch (error) {
  find("failure").replaceChildren(element("p", { class: "note", "data-level": "ERROR", role: "alert" }, `This item cannot be played: ${error.message}`));
}
