// History of a station's health as columns of equal length, for plots; no DOM.

const MAX_ROWS = 3600;

export class History {
  constructor() {
    this.clear();
  }

  clear() {
    this.times_s = [];
    this.newest_ns = -1n;
    this.station = {};
    this.streams = new Map();
    this.nominal_hz = {};
    this.takes = [];
    // Wall clock minus the station's clock.
    this.offset_s = 0;
  }

  // Adds rows of an answer; false where they do not continue the present ones, which are dropped then.
  append({ fields, arrays }) {
    const t_ns = arrays.t_ns.values;
    const offset_s = fields.now_unix_s - fields.now_ns / 1e9;
    const last_s = this.times_s.at(-1) ?? -Infinity;
    const first_s = t_ns.length ? Number(t_ns[0]) / 1e9 + offset_s : Infinity;
    if (fields.now_ns < Number(this.newest_ns) || first_s <= last_s) {
      this.clear();
      return false;
    }
    this.offset_s = offset_s;
    this.nominal_hz = fields.nominal_rate_hz;
    this.takes = fields.takes.map((take) => ({ name: take.recording_id, start_s: take.start_ns / 1e9 + offset_s,
      stop_s: take.stop_ns === null ? Infinity : take.stop_ns / 1e9 + offset_s }));
    for (const t of t_ns) this.times_s.push(Number(t) / 1e9 + offset_s);
    if (t_ns.length) this.newest_ns = t_ns.at(-1);
    const num_rows = t_ns.length;
    const add = (columns, names, values, start) => names.forEach((name, index) => {
      const column = (columns[name] ??= []);
      const first = start + index * num_rows;
      // A plot leaves null out; it would draw through NaN.
      for (let row = first; row < first + num_rows; row += 1) column.push(Number.isNaN(values[row]) ? null : values[row]);
    });
    add(this.station, fields.station_series, arrays.station.values, 0);
    Object.keys(fields.nominal_rate_hz).forEach((name, index) => {
      if (!this.streams.has(name)) this.streams.set(name, {});
      const start = index * fields.stream_series.length * num_rows;
      add(this.streams.get(name), fields.stream_series, arrays.streams.values, start);
    });
    this.forget();
    return true;
  }

  forget() {
    const excess = this.times_s.length - MAX_ROWS;
    if (excess <= 0) return;
    for (const columns of [{ times: this.times_s }, this.station, ...this.streams.values()]) {
      for (const column of Object.values(columns)) column.splice(0, excess);
    }
  }

  column(stream, name) {
    return this.streams.get(stream)?.[name] ?? [];
  }
}

// Column in another unit; `from` is taken off each value.
export function scaled(column, factor, from = 0) {
  return column.map((value) => (value === null ? null : factor * (value - from)));
}

// First known value of the rows from `start_s` on, 0 if there is none.
export function firstKnown(times_s, column, start_s) {
  const index = times_s.findIndex((t_s, row) => t_s >= start_s && column[row] !== null);
  return index < 0 ? 0 : column[index];
}

// Times that a value stays: [start, stop, value]. A row is what was measured until its time.
export function runs(times_s, column, longest_s = 3) {
  const found = [];
  times_s.forEach((t_s, row) => {
    const before_s = times_s[row - 1] ?? t_s - 1;
    const start_s = Math.max(before_s, t_s - longest_s);
    const last = found.at(-1);
    if (last && last[2] === column[row] && last[1] === start_s) last[1] = t_s;
    else found.push([start_s, t_s, column[row]]);
  });
  return found.filter(([, , value]) => value !== null && value !== undefined);
}

// What a page shows, as a query: a length in seconds up to now, or up to `end_s`.
export function viewOf(query, defaults) {
  const parameters = new URLSearchParams(query);
  const read = (name) => (parameters.has(name) && Number.isFinite(Number(parameters.get(name))) ? Number(parameters.get(name)) : null);
  const range_s = read("range");
  return { stream: parameters.get("stream") ?? defaults.stream, end_s: read("end"),
    range_s: range_s === null ? defaults.range_s : Math.min(Math.max(range_s, 10), 3600) };
}

export function queryOf({ stream, range_s, end_s }) {
  const parameters = new URLSearchParams({ stream, range: String(Math.round(range_s)) });
  if (end_s !== null) parameters.set("end", end_s.toFixed(0));
  return `?${parameters}`;
}
