// Pieces that all pages share: elements, notes, buttons, tables, commands to copy, and what the browser keeps. Text is always text, so no name can become markup.

// Attributes that are functions listen to the event of their name.
export function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") node.addEventListener(name, value);
    else if (value !== null && value !== undefined) node.setAttribute(name, String(value));
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

// An element of SVG.
export function shape(name, attributes, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, String(value));
  node.append(...children);
  return node;
}

export function button(content, click, attributes = {}) {
  return element("button", { type: "button", click, ...attributes }, ...[content].flat());
}

export function cell(content, kind = null, attributes = {}) {
  return element("td", { class: kind, ...attributes }, ...[content].flat());
}

// The head of a table; a column is its title, or [title, attributes].
export function headRow(columns) {
  return element("tr", {}, ...columns.map((column) => [column].flat()).map(([title, attributes]) => element("th", { scope: "col", ...attributes }, title)));
}

export function table(columns, lines) {
  return element("table", {}, element("thead", {}, headRow(columns)), element("tbody", {}, ...lines.map((line) => element("tr", {}, ...line.map((content) => cell(content))))));
}

// What a table says in one cell over all of its columns.
export function wideRow(columns, ...words) {
  return element("tr", {}, cell(words, "free", { colspan: columns }));
}

// Rows of a table, or what it says where there are none.
export function showRows(body, rows, columns, ...empty) {
  showChildren(body, rows.length ? rows : [wideRow(columns, ...empty)]);
}

export const find = (id) => document.getElementById(id);

export function onClick(acts) {
  for (const [id, act] of Object.entries(acts)) find(id).addEventListener("click", act);
}

export function onSubmit(form, act = () => {}) {
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    act();
  });
}

export const isModified = (event) => event.ctrlKey || event.metaKey || event.altKey;

export function levelBadge(level, text = level) {
  return element("span", { class: "level", "data-level": level }, text);
}

// Words beneath the value of a cell, if there are some.
export function why(text, kind = "why") {
  return text ? element("span", { class: kind }, text) : null;
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

// Work whose failure is said in a note, after `about`.
export async function attempt(note, work, about = "") {
  try {
    return await work();
  } catch (error) {
    say(note, about + error.message, "ERROR");
    return null;
  }
}

// A function that shows what `read` gives, or how it failed, unless it was called again meanwhile.
export function newestOnly(read, show, fail) {
  let newest = 0;
  return async (...given) => {
    const number = (newest += 1);
    try {
      const found = await read(...given);
      if (number === newest) show(found);
    } catch (error) {
      if (number === newest) fail(error);
    }
  };
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

// The same nodes stay where they are: moving one would take the focus from its buttons.
export function placeChildren(parent, nodes) {
  if (nodes.length !== parent.children.length || nodes.some((node, index) => node !== parent.children[index])) parent.replaceChildren(...nodes);
}

// Rows of a table by key: one stays while its key is shown, so that a click never falls between two buttons.
export class KeyedRows {
  constructor(body) {
    this.body = body;
    this.rows = new Map();
  }

  row(key, make) {
    if (!this.rows.has(key)) this.rows.set(key, make());
    return this.rows.get(key);
  }

  show(rows) {
    for (const [key, row] of this.rows) if (!rows.includes(row)) this.rows.delete(key);
    placeChildren(this.body, rows);
  }
}

export function kept(name, storage = "localStorage") {
  try {
    return window[storage].getItem(name);
  } catch {
    return null;
  }
}

// Null forgets it. A browser that keeps nothing (private windows, a full disk) begins anew, and works.
export function keep(name, text, storage = "localStorage") {
  try {
    if (text === null) window[storage].removeItem(name);
    else window[storage].setItem(name, text);
  } catch {
    // It lasts as long as the page.
  }
}

// As a shell takes it: plain names as they are, anything else in quotes.
export function quote(text) {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}

// A command line and its button Copy; `show` puts another command in its place.
export function commandLine(text = "", code = element("code", {}, text)) {
  const copy = button("Copy", async () => {
    try {
      await navigator.clipboard.writeText(code.textContent);
      copy.textContent = "Copied";
    } catch {
      // Pages that are not served from loopback or by HTTPS have no clipboard.
      getSelection().selectAllChildren(code);
      copy.textContent = "Selected";
    }
  }, { class: "plain" });
  const node = element("p", { class: "command" }, code, copy);
  const show = (changed) => {
    setText(code, changed);
    setText(copy, "Copy");
  };
  return { node, show };
}

// A button that acts on its second click within five seconds.
export function twoStep(text, act) {
  let timer = null;
  const end = () => {
    clearTimeout(timer);
    timer = null;
    setText(node, text);
    node.classList.remove("asked");
  };
  const node = button(text, async () => {
    if (timer === null) {
      setText(node, `${text} now`);
      node.classList.add("asked");
      timer = setTimeout(end, 5000);
      return;
    }
    end();
    node.disabled = true;
    await act().finally(() => { node.disabled = false; });
  }, { class: "danger" });
  return node;
}
