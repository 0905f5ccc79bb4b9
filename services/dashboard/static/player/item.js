// A recording or episode in the store: its facts and streams, and what is read of them.

import { unpack } from "../packed.js";
import { ask, checked } from "../requests.js";
import { after, allAfter, parseExact, stampOf } from "./times.js";

const STORE = "/v1/episode_store";
const LATEST_BEGIN_NS = 1e9;
const POSE = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"];

// JSON of one of the store's routes.
export async function fetchFacts(path) {
  return parseExact(await (await checked(await ask(STORE + path))).text());
}

function playedStream(stream, zero) {
  const relative = (stamp) => (stamp === null ? null : after(stamp, zero));
  return {
    ...stream,
    components: stream.kind === "pose" && stream.shape.join() === "7" ? POSE : stream.components ?? [],
    side: stream.side ?? /_(left|right)$/.exec(stream.name)?.[1] ?? null,
    size: stream.shape.reduce((product, axis) => product * axis, 1),
    period_ns: 1e9 / stream.nominal_rate_hz,
    first_ns: relative(stream.first_ns),
    last_ns: relative(stream.last_ns),
    gaps_ns: stream.gaps_ns.map((gap) => gap.map(relative)),
    interpolated: stream.interpolated.map(({ part, start_ns, stop_ns }) => ({ part, span_ns: [relative(start_ns), relative(stop_ns)] })),
  };
}

export class Item {
  // All times are nanoseconds after `zero`, a stamp of the item's clock.
  constructor(about, zero) {
    this.about = about;
    this.zero = zero;
    this.path = `${about.kind}/${encodeURIComponent(about.id)}`;
    this.start_ns = after(about.start_ns, zero);
    this.stop_ns = after(about.stop_ns, zero);
    this.streams = new Map(about.streams.map((stream) => [stream.name, playedStream(stream, zero)]));
  }

  // Zero is step 0 of an episode and the start of a recording.
  static async open(kind, id) {
    const about = await fetchFacts(`/playback/${kind}/${encodeURIComponent(id)}`);
    return new Item(about, kind === "episode" ? 0n : BigInt(about.started_t_host_ns ?? about.start_ns));
  }

  // The recording that an episode was aligned from, on the episode's time; null with a reason.
  static async openSource(episode) {
    const { lineage, origin_after_start_ns } = episode.about;
    const source = lineage.find((entry) => entry.kind === "recording");
    if (!source) return { item: null, reason: "its lineage names no recording" };
    if (origin_after_start_ns === null) return { item: null, reason: "it does not say when in its recording it begins" };
    try {
      const about = await fetchFacts(`/playback/recording/${encodeURIComponent(source.id)}`);
      return { item: new Item(about, BigInt(about.started_t_host_ns ?? 0) + BigInt(origin_after_start_ns)), reason: "" };
    } catch (error) {
      return { item: null, reason: error.message };
    }
  }

  // Where playing begins: once every stream has a sample, but soon.
  get begin_ns() {
    const firsts_ns = [...this.streams.values()].map((stream) => stream.first_ns);
    const latest_ns = this.start_ns + LATEST_BEGIN_NS;
    return Math.max(this.start_ns, ...firsts_ns.filter((first_ns) => first_ns !== null && first_ns <= latest_ns));
  }

  ofKind(...kinds) {
    return [...this.streams.values()].filter((stream) => kinds.includes(stream.kind));
  }

  async read(route, query, signal) {
    const answer = await checked(await ask(`${STORE}${route}?${new URLSearchParams(query)}`, { signal }));
    return unpack(await answer.arrayBuffer());
  }

  span({ start_ns, stop_ns }) {
    return { start_ns: stampOf(start_ns, this.zero), stop_ns: stampOf(stop_ns, this.zero) };
  }

  async images(camera, span, half_size, signal) {
    const query = { ...this.span(span), half_size };
    const { arrays } = await this.read(`/playback/${this.path}/images/${camera}`, query, signal);
    const data = arrays.data.values;
    let end = 0;
    const images = Array.from(arrays.num_bytes.values, (length) => data.subarray(end, (end += Number(length))));
    return { value: { t_ns: allAfter(arrays.t_ns.values, this.zero), images }, bytes: data.byteLength };
  }

  async samples(stream, span, signal) {
    const { arrays } = await this.read(`/${this.about.kind}s/${encodeURIComponent(this.about.id)}/streams/${stream}`, this.span(span), signal);
    const stamps = arrays[this.about.kind === "episode" ? "t_ref_ns" : "t_host_ns"].values;
    const { values } = arrays.values;
    return { value: { t_ns: allAfter(stamps, this.zero), values }, bytes: values.byteLength + 24 * stamps.length };
  }

  async robotHands(action_kind, span, signal) {
    const { arrays } = await this.read(`/playback/${this.path}/robot_hands`, { ...this.span(span), action_kind }, signal);
    const t_ns = allAfter(arrays.t_ns.values, this.zero);
    return { value: { t_ns, arrays }, bytes: 2000 * t_ns.length };
  }

  // Lowest and highest values per bin of signals, by name.
  async signals(signals, span, points, signal) {
    const { arrays } = await this.read(`/playback/${this.path}/signals`, { names: signals.join(","), ...this.span(span), points }, signal);
    return new Map(signals.map((name) => [name, { low: arrays[`${name}/low`].values, high: arrays[`${name}/high`].values }]));
  }
}
