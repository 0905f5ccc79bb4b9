() => {
  const bit = (context, x, y) => context.getImageData(Math.floor(x), Math.floor(y), 1, 1).data;
  const shown = {};
  for (const pane of document.querySelectorAll("[data-camera]")) {
    if (pane.hidden) continue;
    const canvas = pane.querySelector("canvas");
    const context = canvas.getContext("2d");
    const bits = [];
    for (let row = 0; row < 3; row += 1) for (let column = 0; column < 4; column += 1) {
      bits.push(bit(context, (column + 0.5) * canvas.width / 4, (row + 0.5) * canvas.height / 3)[1] > 127 ? 1 : 0);
    }
    const picture = getComputedStyle(canvas);
    shown[pane.dataset.camera] = { state: pane.dataset.state, stamp: pane.dataset.stamp ?? null, bits,
      time: pane.querySelector("time").textContent, seen: picture.visibility === "visible" };
  }
  for (const pane of document.querySelectorAll(".touch_pane")) {
    const canvas = pane.querySelector("canvas");
    const context = canvas.getContext("2d");
    // A map of 28 rows and 26 columns with a margin of one; the palm's first row is row 13. The left
    // palm's columns run from 10 to the right, the right palm's from 15 to the left.
    const cell = Math.min(canvas.width / 28, canvas.height / 30);
    const isLeft = pane.dataset.stream.endsWith("left");
    const bits = [];
    for (let k = 0; k < 12; k += 1) {
      const column = isLeft ? 10 + k : 15 - k;
      const [red, , blue] = bit(context, (canvas.width - 26 * cell) / 2 + (column + 0.5) * cell, (canvas.height - 28 * cell) / 2 + 13.5 * cell);
      bits.push(red - blue > 50 ? 1 : 0);
    }
    shown[pane.dataset.stream] = { state: pane.dataset.state, stamp: pane.dataset.stamp ?? null, bits };
  }
  for (const row of document.querySelectorAll(".own_times li")) shown[row.dataset.stream] = { state: row.dataset.state, stamp: row.dataset.stamp ?? null };
  const action = document.getElementById("action");
  shown.action = { state: action.dataset.state, stamp: action.dataset.stamp ?? null };
  return { clock: document.getElementById("clock").title, panes: shown };
}
