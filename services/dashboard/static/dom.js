// Small DOM pieces: elements from plain values. Text is always text, so no name can become markup.

export function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) node.setAttribute(name, String(value));
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

export function levelBadge(level) {
  return element("span", { class: "level", "data-level": level }, level);
}

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}
