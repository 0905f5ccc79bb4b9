// A small plot of shares of a nominal value, 1 at the dotted line; unknown values are gaps.

const NAMESPACE = "http://www.w3.org/2000/svg";
const WIDTH = 88;
const HEIGHT = 16;
const TOP = 1.2;
const POINTS = 60;

// Corners of the lines through known values, the newest at the right edge.
export function sparkPath(shares) {
  let path = "";
  let draws = false;
  shares.slice(-POINTS).forEach((share, index, { length }) => {
    if (share === null) {
      draws = false;
      return;
    }
    const x = (WIDTH * (POINTS - length + index)) / (POINTS - 1);
    const y = HEIGHT * (1 - Math.min(Math.max(share, 0), TOP) / TOP);
    path += `${draws ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
    draws = true;
  });
  return path;
}

export function sparkline(shares) {
  const plot = document.createElementNS(NAMESPACE, "svg");
  plot.setAttribute("class", "spark");
  plot.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  plot.setAttribute("aria-hidden", "true");
  const nominal = HEIGHT * (1 - 1 / TOP);
  for (const [name, path] of [["nominal", `M0 ${nominal}H${WIDTH}`], ["shares", sparkPath(shares)]]) {
    const line = document.createElementNS(NAMESPACE, "path");
    line.setAttribute("class", name);
    line.setAttribute("d", path);
    plot.append(line);
  }
  return plot;
}
