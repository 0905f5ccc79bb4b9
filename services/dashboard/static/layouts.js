// Layout of a glove → where its taxels are drawn, as `dextouch.tactile.TactileLayout.hand_canvas` does it; no DOM.

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
