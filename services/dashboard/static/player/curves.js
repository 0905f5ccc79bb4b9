// Curves of a plot from the store's lowest and highest value per bin of time.

const GAP_PERIODS = 1.5;

// Centres of the bins, in seconds for the axis.
export function binCentres(start_ns, stop_ns, points) {
  const step_ns = (stop_ns - start_ns) / points;
  return Array.from({ length: points }, (_, k) => (start_ns + (k + 0.5) * step_ns) / 1e9);
}

// Values of bins as uPlot wants them: null where a gap begins, which breaks the line; undefined in
// bins that are merely shorter than the time between two samples, which the line crosses.
export function withGaps(values, bin_ns, period_ns) {
  const longest = Math.floor((GAP_PERIODS * period_ns) / bin_ns) + 1;
  const found = Array.from(values, (value) => (Number.isNaN(value) ? undefined : value));
  let last = -1;
  for (let k = 0; k <= found.length; k += 1) {
    if (k < found.length && found[k] === undefined) continue;
    const isGap = last < 0 || k === found.length || k - last > longest;
    if (isGap) for (let empty = last + 1; empty < k; empty += 1) found[empty] = null;
    last = k;
  }
  return found;
}

// Parts of the name of a signal: "action.3" is value 3 of the stream "action".
export function signalParts(name) {
  const dot = name.indexOf(".");
  return dot < 0 ? { stream: name, what: "" } : { stream: name.slice(0, dot), what: name.slice(dot + 1) };
}

// The name of a value with its unit: "l_thumb_mcp_rad" is "left thumb mcp" in rad.
export function componentWords(name) {
  const [, text, unit = ""] = /^(.*?)(?:_(m|rad))?$/.exec(name);
  return { text: text.replace(/^([lr])_/, (_, side) => (side === "l" ? "left " : "right ")).replace(/[._]/g, " "), unit };
}

// Title and unit of a signal.
export function signalWords(name, streams) {
  const { stream, what } = signalParts(name);
  const { components, unit } = streams.get(stream);
  if (what === "interval_ms") return { title: `${stream}, time between samples`, unit: "ms" };
  if (!components[what]) return { title: name, unit };
  const words = componentWords(components[what]);
  return { title: `${stream}: ${words.text}`, unit: words.unit };
}

export function isSignal(name, streams) {
  const { stream, what } = signalParts(name);
  const found = streams.get(stream);
  if (!found) return false;
  if (what === "interval_ms") return true;
  if (found.kind === "image") return false;
  const size = found.shape.reduce((product, axis) => product * axis, 1);
  return !what || what === "max" || (/^\d{1,6}$/.test(what) && Number(what) < size);
}
