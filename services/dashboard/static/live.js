// The one websocket: tells the server what is in view, hands out what comes back, reconnects by itself, and says so in #link.

import { setText } from "./dom.js";
import { ask, stationPath } from "./session.js";

const FIRST_RETRY_MS = 500;
const LONGEST_RETRY_MS = 8000;

export class LiveLink {
  constructor({ onTopic, onBinary = () => {}, onState = () => {} }) {
    this.onTopic = onTopic;
    this.onBinary = onBinary;
    this.onState = (connected) => {
      setText(document.getElementById("link"), connected ? "live" : "dashboard not reachable: what you see is old");
      onState(connected);
    };
    document.addEventListener("visibilitychange", () => this.sendView());
    this.view = new Set();
    this.retry_ms = FIRST_RETRY_MS;
    this.socket = null;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${stationPath("/v1/live")}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.retry_ms = FIRST_RETRY_MS;
      this.onState(true);
      this.sendView();
    };
    socket.onmessage = (event) => {
      if (event.data instanceof ArrayBuffer) {
        this.onBinary(event.data);
      } else {
        const message = JSON.parse(event.data);
        this.onTopic(message.topic, message.data);
      }
    };
    socket.onclose = async () => {
      this.onState(false);
      // Why a socket is refused no page sees; the answer to a request tells whether the session ended.
      await ask("/v1/heatmap", { signal: AbortSignal.timeout(LONGEST_RETRY_MS) }).catch(() => null);
      setTimeout(() => this.open(), this.retry_ms);
      this.retry_ms = Math.min(2 * this.retry_ms, LONGEST_RETRY_MS);
    };
    this.socket = socket;
  }

  show(topic, visible) {
    const changed = visible ? !this.view.has(topic) : this.view.has(topic);
    if (!changed) return;
    if (visible) this.view.add(topic);
    else this.view.delete(topic);
    this.sendView();
  }

  sendView() {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const view = document.hidden ? [] : [...this.view];
    this.socket.send(JSON.stringify({ view }));
  }
}
