// Taxels of a hand: where a glove's layout has them, their names, states and forces; no DOM, so that node can test it.

// The heat map for the gloves of a layout (JSON of TactileLayout); null is the glove that the heat map is of.
export function withLayout(heatmap, layout) {
  if (!layout) return heatmap;
  const [rows, columns] = layout.canvas;
  const cells = { left: [], right: [] };
  let start = 0;
  const pads = layout.pads.map((pad) => {
    const [top, left] = pad.origin;
    for (let row = 0; row < pad.rows; row += 1) {
      for (let column = 0; column < pad.columns; column += 1) {
        // Radial is on the right of a right hand, while taxels run from radial to ulnar.
        const place = left + pad.columns - 1 - column;
        cells.right.push((top + row) * columns + place);
        cells.left.push((top + row) * columns + columns - 1 - place);
      }
    }
    const found = { part: pad.part, start, rows: pad.rows, columns: pad.columns, taxel_area_mm2: 1e6 * pad.taxel_area_m2 };
    start += pad.rows * pad.columns;
    return found;
  });
  return { ...heatmap, rows, columns, cells, pads, num_raw_cells: layout.num_raw_cells, raw_cells: layout.raw_cells };
}

export const PADS = ["thumb", "index", "middle", "ring", "little", "palm"];

// In the order of the legend; the first one of a taxel is shown.
export const STATES = {
  dead: { level: "ERROR", mark: "cross", text: "dead: reads nothing" },
  saturated: { level: "ERROR", mark: "triangle", text: "saturated: at full scale" },
  stuck: { level: "WARN", mark: "bar", text: "stuck: keeps one load" },
  drifting: { level: "WARN", mark: "diamond", text: "drifting: its own zero has moved" },
  gone: { level: "ERROR", mark: "cross", text: "gone: sends no number" },
  refused: { level: "STALE", mark: "ring", text: "refused by the calibration, which gives it the gain of its pad" },
  absent: { level: "STALE", mark: "dot", text: "absent: no cell of this glove measures it" },
  unmeasured: { level: "STALE", mark: "dot", text: "not measured: alignment refused it, it reads zero" },
};

// States in which a taxel still measures; undefined is one in order.
const MEASURES = new Set([undefined, "refused"]);

// The pad that a taxel is on; `pads` are those of the heat map.
function padOf(taxel, pads) {
  return pads.findLast((pad) => pad.start <= taxel);
}

// Pad, row from distal to proximal and column from the thumb's side, counted from 1.
export function taxelName(taxel, pads) {
  const { part, start, columns } = padOf(taxel, pads);
  const inPad = taxel - start;
  return `${part}${part === "palm" ? "" : " tip"}, row ${Math.floor(inPad / columns) + 1}, column ${(inPad % columns) + 1}`;
}

// Pressures without those of taxels that are out of order: what they read is no touch.
export function trusted(pressures_kpa, states) {
  return pressures_kpa.map((pressure_kpa, taxel) => (MEASURES.has(states.get(taxel)) ? pressure_kpa : 0));
}

// Force on each of PADS in newton: pressure times area of the taxels in contact.
export function padForces(pressures_kpa, contact_kpa, pads) {
  const forces_n = new Array(PADS.length).fill(0);
  pressures_kpa.forEach((pressure_kpa, taxel) => {
    const { part, taxel_area_mm2 } = padOf(taxel, pads);
    if (pressure_kpa >= contact_kpa) forces_n[PADS.indexOf(part)] += pressure_kpa * taxel_area_mm2 * 1e-3;
  });
  return forces_n;
}

// State of each taxel that is out of order, from {state: [taxel, …]}; unknown states of later releases are left out.
export function statesOf(taxels) {
  const found = new Map();
  for (const state of Object.keys(STATES)) for (const taxel of taxels[state] ?? []) if (!found.has(taxel)) found.set(taxel, state);
  return found;
}
