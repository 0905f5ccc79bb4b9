// Pure modules of the player; `node --test` runs this beside a copy of the page's static files.

import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import { test } from "node:test";

import { exportCommand, itemsOfKind } from "./static/catalog/export.js";
import { bytes, date } from "./static/format.js";
import { Blocks, FetchQueue, lastAtOrBefore } from "./static/player/tracks.js";
import { binCentres, componentWords, isSignal, withGaps } from "./static/player/plots.js";
import { relabelCommand, stepsOf, trimCommand } from "./static/player/editing.js";
import { byStage, largestChange, worstOf } from "./static/player/facts.js";
import { HandDriving, moveOf } from "./static/hand_driving.js";
import { outcomeOf } from "./static/rollout_rows.js";
import { unpack } from "./static/packed.js";
import { apply, matrixOfPose } from "./static/poses.js";
import { allAfter, clockText, formatState, parseSeconds, parseState, PlayClock, secondsText, stampOf, ticks, tickText } from "./static/player/times.js";

const near = (found, expected) => found.forEach((value, k) => assert.ok(Math.abs(value - expected[k]) < 1e-12, `${found} is not ${expected}`));

// Bodies that Python packed, beside what they contain; bigints and NaN as text.
function plain(value) {
  if (typeof value === "bigint" || Number.isNaN(value) || value === Infinity) return String(value);
  if (ArrayBuffer.isView(value)) return Array.from(value, plain);
  if (Array.isArray(value)) return value.map(plain);
  if (value && typeof value === "object") return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, plain(one)]));
  return value;
}

for (const name of readdirSync("packed").filter((one) => one.endsWith(".bin"))) {
  test(`a body that Python packed: ${name}`, () => {
    const bytes = readFileSync(`packed/${name}`);
    const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
    assert.deepEqual(plain(unpack(buffer)), JSON.parse(readFileSync(`packed/${name.replace(".bin", ".json")}`, "utf8")));
    for (const length of [0, 1, Math.floor(buffer.byteLength / 2), buffer.byteLength - 1]) assert.throws(() => unpack(buffer.slice(0, length)));
  });
}

test("a body of another form is refused", () => {
  for (const bytes of [[0xc1], [0x80], [0x82, 0xa6], [0x92, 1, 2], [0xc0]]) assert.throws(() => unpack(Uint8Array.from(bytes).buffer));
});

test("times are exact beyond 2^53", () => {
  const zero = 1_760_000_000_123_456_789n;
  assert.deepEqual([...allAfter(BigInt64Array.of(zero, zero + 1n, zero - 5n), zero)], [0, 1, -5]);
  assert.equal(stampOf(7, zero), "1760000000123456796");
  for (const [ns, text] of [[0, "0"], [1_500_000_000, "1.5"], [12_345_678_901, "12.345678901"], [-20_000_000, "-0.02"]]) {
    assert.equal(secondsText(ns), text);
    assert.equal(parseSeconds(text), ns);
  }
  for (const text of ["", "x", "1e3", "1.2.3", null, "99999999"]) assert.equal(parseSeconds(text), null);
  assert.equal(clockText(83_456_700_000), "1:23.457");
  assert.equal(clockText(59_999_900_000), "1:00.000");
});

test("dates have one form, and values their unit", () => {
  assert.equal(date("2026-11-30T14:05:09"), "30 Nov 2026, 14:05:09");
  assert.deepEqual(["day", "time", "minute"].map((name) => date("2026-01-02T03:04:05", name)), ["2 Jan 2026", "03:04:05", "03:04"]);
  assert.equal(date(Date.parse("2026-11-30T14:05:09") / 1000), "30 Nov 2026, 14:05:09");
  assert.deepEqual([null, undefined, "", "soon", NaN].map((at) => date(at)), Array(5).fill("–"));
  assert.deepEqual([0, 999.6, 999_600_000, 123_456_789, 1e19, null].map(bytes), ["0 B", "1 kB", "1.0 GB", "123 MB", "10000 PB", "–"]);
  assert.deepEqual(componentWords("l_index_finger_mcp_abd_rad"), { text: "left index finger mcp abd", unit: "rad" });
  assert.deepEqual(componentWords("camera_head.x_m"), { text: "camera head x", unit: "m" });
  assert.deepEqual(componentWords("wrist_left.r00"), { text: "wrist left r00", unit: "" });
});

test("a ruler has round marks", () => {
  const { at_ns, step_ns } = ticks(0, 20e9, 8);
  assert.deepEqual(at_ns.map((ns) => tickText(ns, step_ns)), ["0", "5", "10", "15", "20"]);
  assert.equal(tickText(1.25e9, 5e7), "1.25");
});

test("the sample that is valid at a time", () => {
  const blocks = new Blocks({ first_ns: 100, last_ns: 990, period_ns: 10, block_ns: 100 });
  assert.equal(blocks.count, 9);
  const held = { 0: [100, 110, 195], 1: [], 2: [300, 310], 8: [985, 990] };
  const get = (index) => held[index] && { t_ns: held[index] };
  const at = (t_ns) => blocks.sampleAt(t_ns, get);
  assert.deepEqual(at(99), { state: "none" });
  assert.deepEqual(at(109.5), { state: "sample", block: 0, index: 0, t_ns: 100 });
  // 15 ns are one and a half periods.
  assert.deepEqual(at(125), { state: "sample", block: 0, index: 1, t_ns: 110 });
  assert.deepEqual(at(126), { state: "none" });
  // The block of this time holds nothing yet, the sample of the block before is valid.
  assert.deepEqual(at(205), { state: "sample", block: 0, index: 2, t_ns: 195 });
  assert.deepEqual(at(250), { state: "none" });
  assert.deepEqual(at(450), { state: "loading", block: 3 });
  assert.deepEqual(at(1005), { state: "sample", block: 8, index: 1, t_ns: 990 });
  assert.deepEqual(at(1006), { state: "none" });
  assert.deepEqual(new Blocks({ first_ns: null, last_ns: null, period_ns: 10, block_ns: 10 }).sampleAt(5, get), { state: "none" });
  assert.equal(lastAtOrBefore([1, 2, 2, 3], 2), 2);
});

test("the queue stays within its budget and loads what is urgent first", async () => {
  const loaded = [];
  const queue = new FetchQueue({ budget_bytes: 30, concurrency: 1 });
  const entry = (key, urgent = false) => ({ key, bytes: 10, urgent, load: async () => { loaded.push(key); return { value: key, bytes: 10 }; } });
  const idle = async () => { while (queue.running.size) await new Promise((done) => setTimeout(done)); };
  queue.want([entry("a", true), entry("b"), entry("c"), entry("d")]);
  await idle();
  assert.deepEqual(loaded, ["a", "b", "c"]);
  queue.want([entry("c", true), entry("e"), entry("f")]);
  await idle();
  assert.deepEqual(loaded, ["a", "b", "c", "e", "f"]);
  assert.equal(queue.kept_bytes, 30);
  assert.deepEqual([...queue.kept.keys()].sort(), ["c", "e", "f"]);
});

test("what is not wanted any more is aborted; failures are kept and tried again later", async () => {
  let now_ms = 0;
  let aborted = 0;
  let tries = 0;
  const queue = new FetchQueue({ budget_bytes: 30, now_ms: () => now_ms });
  const slow = { key: "slow", bytes: 1, load: (signal) => new Promise((_, fail) => signal.addEventListener("abort", () => { aborted += 1; fail(new Error("aborted")); })) };
  const broken = { key: "broken", bytes: 1, load: async () => { tries += 1; throw new Error("no store"); } };
  const turn = () => new Promise((done) => setTimeout(done));
  queue.want([slow]);
  queue.want([broken]);
  await turn();
  assert.deepEqual([aborted, tries, queue.failure("broken").message, queue.failure("slow")], [1, 1, "no store", undefined]);
  queue.want([broken]);
  await turn();
  assert.equal(tries, 1);
  now_ms = 5000;
  queue.want([broken]);
  await turn();
  assert.equal(tries, 2);
});

test("the clock waits for what is loading, and ends at the end", () => {
  const clock = new PlayClock(0, 1e9);
  clock.speed = 2;
  clock.toggle();
  assert.equal(clock.tick(0, () => true), false);
  assert.equal(clock.tick(100, () => false), false);
  assert.equal(clock.tick(200, () => true), true);
  assert.equal(clock.t_ns, 2e8);
  for (let now_ms = 300; now_ms < 1000; now_ms += 100) clock.tick(now_ms, () => true);
  assert.deepEqual([clock.t_ns, clock.playing], [1e9, false]);
  clock.toggle();
  assert.equal(clock.t_ns, 0);
});

test("a link is read as it was written", () => {
  const state = { at_ns: 12_345_678_901, cameras: ["camera_head"], signals: ["action.3", "tactile_left"], zoom_ns: [-5e6, 2e9], view: [1.5, -0.25, 0.8], raw: true, hidden: ["measured"], speed: 0.5 };
  assert.deepEqual(parseState(formatState(state)), state);
  const usual = parseState("?at=soon&zoom=5~1&speed=90&view=1~x~2&cameras=");
  assert.deepEqual(usual, { at_ns: null, cameras: [], signals: null, zoom_ns: null, view: null, raw: false, hidden: [], speed: 1 });
});

test("curves break at gaps, and only there", () => {
  assert.deepEqual(binCentres(0, 4e9, 4), [0.5, 1.5, 2.5, 3.5]);
  // Bins of 1 at a period of 2: every second bin is empty; after a gap two more are.
  assert.deepEqual(withGaps([NaN, 1, NaN, 2, NaN, NaN, NaN, NaN, 3, NaN], 1, 2), [null, 1, undefined, 2, null, null, null, null, 3, null]);
  const streams = new Map([["action", { kind: "robot_state", shape: [67] }], ["camera", { kind: "image", shape: [4, 4, 3] }]]);
  for (const name of ["action", "action.66", "action.max", "camera.interval_ms"]) assert.ok(isSignal(name, streams), name);
  for (const name of ["action.67", "action.x", "camera", "constructor", "", "action."]) assert.equal(isSignal(name, streams), name === "action.", name);
});

test("a pose moves points as a quarter turn about z does", () => {
  const half = Math.SQRT1_2;
  const T = matrixOfPose([1, 2, 3, half, 0, 0, half]);
  near(apply(T, [1, 0, 0]), [1, 3, 3]);
  near(apply(T, [0, 1, 0]), [0, 2, 3]);
  // 120 degrees about (1, 1, 1) takes x to y, y to z and z to x.
  near(apply(matrixOfPose([0, 0, 0, 0.5, 0.5, 0.5, 0.5]), [1, 2, 3]), [3, 1, 2]);
  assert.equal(matrixOfPose([NaN, 0, 0, 1, 0, 0, 0]), null);
  assert.equal(matrixOfPose([0, 0, 0, 0, 0, 0, 0]), null);
});

test("figures are grouped by the stage that measured them, in words", () => {
  const quality = { tactile_left_num_gaps: 2, retargeting_left_tip_error_p95_mm: 4.21764, static_share: 0.25, origin_after_start_ns: 250_000_007, wrist_left_peak_speed_m_s: 0.5 };
  assert.deepEqual(byStage(quality).map(([stage, figures]) => [stage, ...figures.map(({ text, value }) => `${text} = ${value}`)]), [
    ["Retargeting", "left tip error, 95th percentile = 4.218 mm"],
    ["Motion", "static share = 25 %", "wrist left peak speed = 0.5 m/s"],
    ["Synchronization", "origin after start = 0.25 s"],
    ["Recorded streams", "tactile left: gaps = 2"],
  ]);
});

test("the worst second is where a gap is longest, or a signal changes most", async () => {
  const action = { name: "action", num_samples: 20, first_ns: 0, last_ns: 19e9, gaps_ns: [], interpolated: [{ span_ns: [1e9, 2e9] }, { span_ns: [3e9, 7e9] }] };
  const head = { name: "head", num_samples: 9, gaps_ns: [[1e9, 2e9], [5e9, 8e9]] };
  // A step of one metre between the bins 11 and 12.
  const high = Array.from({ length: 20 }, (_, k) => (k > 11 ? 1 : 0));
  const item = { start_ns: 0, stop_ns: 20e9, streams: new Map([["action", action], ["head", head]]), signals: async (names) => new Map(names.map((name) => [name, { high }])) };
  assert.deepEqual(await worstOf(item, "head_num_gaps")(), [5e9, 8e9]);
  assert.deepEqual(await worstOf(item, "num_steps_interpolated")(), [3e9, 7e9]);
  const [from_ns, to_ns] = await worstOf(item, "wrist_left_peak_speed_m_s")();
  assert.ok(from_ns < 11.4e9 && 11.4e9 < to_ns && to_ns - from_ns === 1e9);
  assert.equal(worstOf(item, "static_share"), null);
  assert.equal(worstOf(item, "retargeting_left_tip_error_mm"), null);
  assert.equal(largestChange([[0, 0, 5, 5]], 1), 1.5);
  assert.equal(largestChange([[1]], 1), null);
});

test("a selection is steps of the grid, from its start to before its end", () => {
  const about = { num_steps: 31, model_rate_hz: 15 };
  assert.deepEqual(stepsOf([0, 2e9], about), [0, 31]);
  assert.deepEqual(stepsOf([1e9, 1.9e9], about), [15, 29]);
  // Step 1 is at 66 666 667 ns, on which a playhead can stand.
  assert.deepEqual(stepsOf([66_666_667, 133_333_333], about), [1, 2]);
  assert.deepEqual(stepsOf([-5e8, 9e9], about), [0, 31]);
});

test("commands can be pasted into a shell", () => {
  assert.equal(trimCommand("a", [15, 29], { outcome: "keep", keep: false }), "dextouch store trim a --steps 15 29 --outcome keep");
  const labels = { task: undefined, instruction: "it's $(up)", operator: "", outcome: "", keep: true };
  assert.equal(relabelCommand({ kind: "recording", id: "a" }, labels), `dextouch store relabel a --kind recording --instruction 'it'\\''s $(up)' --keep`);
});

test("a selection without an item of the kind has no command to export", () => {
  const ids = itemsOfKind([{ kind: "recording", id: "a" }], "episode").map(({ id }) => id);
  assert.equal(exportCommand({ format: "mcap", kind: "episode", ids, filters: {} }), "");
  assert.match(exportCommand({ format: "mcap", kind: "recording", ids: ["a"], filters: {} }), / a --to a.mcap$/);
  assert.match(exportCommand({ format: "mcap", kind: "episode", ids: null, filters: { task: "wipe" } }), /--task=wipe/);
});

test("held keys and a gamepad move hands, opposite keys cancel, and a stick at rest does not", () => {
  assert.deepEqual(moveOf(new Set(["w", "d", " ", "x"])), { forward: 1, right: 1, close: 1 });
  assert.equal(moveOf(new Set(["w", "s"])).forward, 0);
  const pad = { axes: [0.5, -1, 0.1, 0.4], buttons: Array.from({ length: 8 }, (_, index) => ({ value: index === 6 ? 1 : 0 })) };
  assert.deepEqual(moveOf(new Set(), pad), { right: 0.5, forward: 1, up: -0.4, close: -1 });
  assert.deepEqual(moveOf(new Set(["w"]), pad).forward, 1);
});

test("a refused move is said once, and tried again after the keys were let go", async () => {
  const listeners = {}, output = { dataset: {} };
  const pad = { addEventListener: (name, work) => { listeners[name] = work; }, querySelector: () => output };
  globalThis.document = { activeElement: pad };
  globalThis.navigator ??= {};
  let asked = 0;
  const driving = new HandDriving(pad, { value: "both" }, async () => { asked += 1; throw new Error("it is over"); });
  const press = () => listeners.keydown({ key: "W", preventDefault: () => {} });
  press();
  for (let frame = 0; frame < 9; frame += 1) {
    await driving.tick();
    press(); // as keys that are held down repeat
  }
  assert.deepEqual([asked, output.textContent, output.dataset.level], [1, "it is over", "ERROR"]);
  listeners.keyup({ key: "w" });
  await driving.tick();
  press();
  await driving.tick();
  assert.equal(asked, 2);
  delete globalThis.document;
});

test("an outcome is what the world knows, else its own estimate", () => {
  const words = [{ success: true }, { success: false }, { success: null, rollout_doubt: { success_probability: 0.256 } }, { success: null }].map(outcomeOf);
  assert.deepEqual(words, ["success", "no success", "success with 26 %, imagined", "–"]);
});
