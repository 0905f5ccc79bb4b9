// Small DOM pieces: elements from plain values. Text is always text, so no name can become markup.

export function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) node.setAttribute(name, String(value));
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

export const find = (id) => document.getElementById(id);

export function levelBadge(level, text = level) {
  return element("span", { class: "level", "data-level": level }, text);
}

// Words beneath the value of a cell, if there are some.
export function why(text) {
  return text ? element("span", { class: "why" }, text) : null;
}

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// A note in the colour of its level, if it has one.
export function say(node, text, level = null) {
  if (level) node.dataset.level = level;
  else delete node.dataset.level;
  setText(node, text);
}

// Work now, and again and again while somebody looks at the page.
export function repeat(work, period_ms) {
  let timer = null;
  const tick = async () => {
    clearTimeout(timer);
    if (!document.hidden) await work();
    clearTimeout(timer);
    timer = setTimeout(tick, period_ms);
  };
  document.addEventListener("visibilitychange", () => { if (!document.hidden) tick(); });
  return tick();
}

function isSame(old, fresh) {
  return old.nodeName === fresh.nodeName && old.dataset?.key === fresh.dataset?.key;
}

function patch(old, fresh) {
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== fresh.data) old.data = fresh.data;
    return;
  }
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name) && name !== "open") old.removeAttribute(name);
  for (const { name, value } of fresh.attributes) if (name !== "open" && old.getAttribute(name) !== value) old.setAttribute(name, value);
  showChildren(old, [...fresh.childNodes]);
}

// Show these nodes, changing only what differs: a click, the focus and selected text survive updates. What has listeners of
// its own needs a `data-key`, since nodes of the same key stay with their listeners.
export function showChildren(parent, nodes) {
  nodes.forEach((fresh, index) => {
    const old = parent.childNodes[index];
    if (!old) parent.append(fresh);
    else if (isSame(old, fresh)) patch(old, fresh);
    else old.replaceWith(fresh);
  });
  while (parent.childNodes.length > nodes.length) parent.lastChild.remove();
}
