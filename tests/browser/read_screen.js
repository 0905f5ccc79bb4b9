// What a screen does wrong that can be computed: overflow of the page, cut texts, and text with less contrast than WCAG 2.1 AA.
() => {
  const pixel = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const known = new Map();
  const colour = (text) => {
    if (!known.has(text)) {
      pixel.clearRect(0, 0, 1, 1);
      pixel.fillStyle = text;
      pixel.fillRect(0, 0, 1, 1);
      const [red, green, blue, alpha] = pixel.getImageData(0, 0, 1, 1).data;
      known.set(text, [red, green, blue, alpha / 255]);
    }
    return known.get(text);
  };
  const over = ([r, g, b, a], below) => [r, g, b].map((value, k) => a * value + (1 - a) * below[k]);
  const luminance = (rgb) => rgb.map((value) => value / 255)
    .map((share) => (share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4))
    .reduce((sum, share, k) => sum + [0.2126, 0.7152, 0.0722][k] * share, 0);
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
    return (high + 0.05) / (low + 0.05);
  };
  const ancestors = (node) => {
    const found = [];
    for (let at = node; at; at = at.parentElement) found.unshift(at);
    return found;
  };
  const contrast = (node, ink) => {
    let ground = colour("canvas").slice(0, 3);
    let opacity = 1;
    for (const at of ancestors(node)) {
      const style = getComputedStyle(at);
      opacity *= Number(style.opacity);
      const [r, g, b, a] = colour(style.backgroundColor);
      ground = over([r, g, b, a * opacity], ground);
    }
    const [r, g, b, a] = colour(ink);
    return ratio(over([r, g, b, a * opacity], ground), ground);
  };
  const isShown = (node) => node.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && node.getClientRects().length > 0
    && !node.closest(".off_screen, option, datalist, noscript");
  const isInactive = (node) => Boolean(node.closest(":disabled") ?? node.closest("label")?.control?.disabled);
  const name = (node, text) => `${node.tagName.toLowerCase()}${node.id && `#${node.id}`}${node.className && typeof node.className === "string" ? `.${node.className.replaceAll(" ", ".")}` : ""} “${text.trim().slice(0, 40)}”`;
  const faults = [];
  const judge = (node, ink, text) => {
    const style = getComputedStyle(node);
    const size_px = parseFloat(style.fontSize);
    const isLarge = size_px >= 24 || (size_px >= 18.66 && Number(style.fontWeight) >= 700);
    const found = contrast(node, ink);
    if (found < (isLarge ? 3 : 4.5) - 0.005) faults.push(`contrast ${found.toFixed(2)}: ${name(node, text)}`);
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const judged = new Set();
  for (let text = walker.nextNode(); text; text = walker.nextNode()) {
    const node = text.parentElement;
    if (judged.has(node) || !text.data.trim() || !isShown(node) || isInactive(node)) continue;
    judged.add(node);
    judge(node, getComputedStyle(node).color, text.data);
  }
  for (const node of document.querySelectorAll("input, textarea, select")) {
    if (!isShown(node) || isInactive(node) || ["radio", "checkbox", "range", "hidden"].includes(node.type)) continue;
    judge(node, getComputedStyle(node).color, node.value ?? "");
    if (node.placeholder) judge(node, getComputedStyle(node, "::placeholder").color, node.placeholder);
  }
  // Buttons and titles whose words do not fit are cut off; what is meant to be cut has an ellipsis.
  for (const node of document.querySelectorAll("button, h1, h2, h3, th, dt, .level, .screens a")) {
    if (!isShown(node) || getComputedStyle(node).textOverflow === "ellipsis") continue;
    if (getComputedStyle(node).overflowX !== "visible" && node.scrollWidth > node.clientWidth + 1) faults.push(`cut off: ${name(node, node.textContent)}`);
  }
  const page = document.documentElement;
  if (page.scrollWidth > page.clientWidth) {
    const wide = [...document.body.querySelectorAll("*")].filter((node) => isShown(node) && node.getBoundingClientRect().right > page.clientWidth + 1);
    faults.push(`${page.scrollWidth} px wide, the window ${page.clientWidth}: ${wide.slice(0, 3).map((node) => name(node, node.textContent)).join(", ")}`);
  }
  return [...new Set(faults)];
}
