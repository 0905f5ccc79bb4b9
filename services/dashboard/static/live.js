// The one websocket of a page, and the notice that nothing new came, so that no page shows an old value as a new one.

import { find, setText } from "./dom.js";
import { ask, stationPath } from "./requests.js";

export class Freshness {
  constructor(limit_ms, onStale) {
    Object.assign(this, { limit_ms, onStale });
  }

  note() {
    clearTimeout(this.timer);
    this.timer = setTimeout(this.onStale, this.limit_ms);
  }

  stop() {
    clearTimeout(this.timer);
  }
}

const FIRST_RETRY_MS = 500;
const LONGEST_RETRY_MS = 8000;

// Tells the server what is in view, hands out what comes back, reconnects by itself, and says so in #link.
export class LiveLink {
  // Functions by topic; those of `view` are shown from the beginning. Without a link `onLost` is called, each time that it cannot be opened.
  constructor({ topics, view = Object.keys(topics), onOther = () => {}, onBinary = () => {}, onLost = () => {} }) {
    Object.assign(this, { topics, view: new Set(view), onOther, onBinary, onLost, retry_ms: FIRST_RETRY_MS });
    document.addEventListener("visibilitychange", () => this.sendView());
    this.open();
  }

  showState(isConnected) {
    setText(find("link"), isConnected ? "live" : "dashboard not reachable: what you see is old");
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${stationPath("/v1/live")}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.retry_ms = FIRST_RETRY_MS;
      this.showState(true);
      this.sendView();
    };
    socket.onmessage = (event) => {
      if (event.data instanceof ArrayBuffer) return this.onBinary(event.data);
      const { topic, data } = JSON.parse(event.data);
      return Object.hasOwn(this.topics, topic) ? this.topics[topic](data) : this.onOther(topic, data);
    };
    socket.onclose = async () => {
      this.showState(false);
      this.onLost();
      // Why a socket is refused no page sees; the answer to a request tells whether the session ended.
      await ask("/v1/heatmap", { signal: AbortSignal.timeout(LONGEST_RETRY_MS) }).catch(() => null);
      setTimeout(() => this.open(), this.retry_ms);
      this.retry_ms = Math.min(2 * this.retry_ms, LONGEST_RETRY_MS);
    };
    this.socket = socket;
  }

  show(topic, visible) {
    if (this.view.has(topic) === visible) return;
    this.view[visible ? "add" : "delete"](topic);
    this.sendView();
  }

  sendView() {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const view = document.hidden ? [] : [...this.view];
    this.socket.send(JSON.stringify({ view }));
  }
}
