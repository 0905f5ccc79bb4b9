// Pressures of one hand → a canvas in hand layout. Layout and colours come from the server, which
// takes them from dextouch.tactile.heatmap, so that report and page show the same picture.

const GAP = 0.09;
const TIP_TAXELS = 16;
const NUM_TIPS = 5;

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function box(cells, columns) {
  const rows = cells.map((cell) => Math.floor(cell / columns));
  const cols = cells.map((cell) => cell % columns);
  const [top, left] = [Math.min(...rows), Math.min(...cols)];
  return { top, left, height: Math.max(...rows) - top + 1, width: Math.max(...cols) - left + 1 };
}

export class HandCanvas {
  constructor(canvas, text, side, heatmap) {
    this.canvas = canvas;
    this.text = text;
    this.heatmap = heatmap;
    this.cells = heatmap.cells[side];
    this.pads = [];
    for (let tip = 0; tip < NUM_TIPS; tip += 1) {
      this.pads.push(box(this.cells.slice(tip * TIP_TAXELS, (tip + 1) * TIP_TAXELS), heatmap.columns));
    }
    this.palm = box(this.cells.slice(NUM_TIPS * TIP_TAXELS), heatmap.columns);
    this.pressures_kpa = null;
    this.waiting = false;
    new ResizeObserver(() => this.request()).observe(canvas);
    this.request();
  }

  update(pressures_kpa) {
    this.pressures_kpa = pressures_kpa;
    this.request();
  }

  clear(words) {
    this.pressures_kpa = null;
    this.text.textContent = words;
    this.request();
  }

  request() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const scale = window.devicePixelRatio || 1;
    const width = Math.round(this.canvas.clientWidth * scale);
    const height = Math.round(this.canvas.clientHeight * scale);
    if (width === 0 || height === 0) return;
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    const margin = 1;
    const cell_px = Math.min(width / (this.heatmap.columns + 2 * margin), height / (this.heatmap.rows + 2 * margin));
    const context = this.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, width, height);
    context.setTransform(cell_px, 0, 0, cell_px,
      (width - cell_px * this.heatmap.columns) / 2, (height - cell_px * this.heatmap.rows) / 2);
    this.drawSilhouette(context);
    this.drawTaxels(context);
  }

  drawSilhouette(context) {
    const { top, left, height, width } = this.palm;
    context.fillStyle = context.strokeStyle = css("--hand");
    context.lineCap = "round";
    context.lineWidth = 4.9;
    for (const pad of this.pads) {
      const x = pad.left + pad.width / 2;
      const inside = Math.min(Math.max(x, left + 2.5), left + width - 2.5);
      context.beginPath();
      context.moveTo(x, pad.top + 1.9);
      if (inside === x) {
        context.lineTo(x, top + 4);
      } else {
        context.lineTo(x, pad.top + 3);
        context.lineTo(inside, top + 8);
      }
      context.stroke();
    }
    context.beginPath();
    context.roundRect(left - 0.5, top - 0.5, width + 1, height + 1, 2.6);
    context.fill();
  }

  drawTaxels(context) {
    const { ramp, columns, full_scale_kpa, contact_kpa } = this.heatmap;
    const empty = css("--cell");
    let peak_kpa = 0;
    let touching = 0;
    this.cells.forEach((cell, taxel) => {
      const pressure_kpa = this.pressures_kpa ? this.pressures_kpa[taxel] : NaN;
      if (Number.isFinite(pressure_kpa) && pressure_kpa >= contact_kpa / 2) {
        const share = Math.min(pressure_kpa / full_scale_kpa, 1);
        const [red, green, blue] = ramp[Math.round(share * (ramp.length - 1))];
        context.fillStyle = `rgb(${red} ${green} ${blue})`;
        peak_kpa = Math.max(peak_kpa, pressure_kpa);
        if (pressure_kpa >= contact_kpa) touching += 1;
      } else {
        context.fillStyle = empty;
      }
      const row = Math.floor(cell / columns);
      const column = cell % columns;
      context.beginPath();
      context.roundRect(column + GAP, row + GAP, 1 - 2 * GAP, 1 - 2 * GAP, 0.24);
      context.fill();
    });
    if (this.pressures_kpa) {
      this.text.textContent = touching === 0 ? "no contact" : `${touching} taxels in contact, peak ${peak_kpa.toFixed(0)} kPa`;
    }
  }
}

export function drawScale(canvas, heatmap) {
  const context = canvas.getContext("2d");
  heatmap.ramp.forEach(([red, green, blue], index) => {
    context.fillStyle = `rgb(${red} ${green} ${blue})`;
    const left = (index / heatmap.ramp.length) * canvas.width;
    context.fillRect(left, 0, canvas.width / heatmap.ramp.length + 1, canvas.height);
  });
}

// Binary message: uint8 kind (1), uint8 side (0 left, 1 right), uint16 count, count × float32 kPa, little endian.
export function readTaxels(buffer) {
  const view = new DataView(buffer);
  if (view.getUint8(0) !== 1) return null;
  const side = view.getUint8(1) === 0 ? "left" : "right";
  return { side, pressures_kpa: new Float32Array(buffer, 4, view.getUint16(2, true)) };
}
