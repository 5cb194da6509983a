// A node's images and anchors in a web page, through `sags bridge web`: see docs/bridges.md for what comes.
//
//     const sags = new Sags();                                          // ws://HOST/ws of this page
//     sags.show("sags/thin/half/left/render/image/jpeg", canvas);       // any image topic
//     sags.anchors("sags/anchors", (rows) => ...);                      // [] when they are not new any more
//
// `sags.units[topic]` is "relative" where nobody has calibrated the eyes: lengths have no unit then.
// A canvas is cleared, transparent, as soon as what it shows is older than `maxAge`, whatever the reason.
export const NEAR = 0.03, FAR = 0.2; // m, of the colours of depth: warm to cold
const COLOURS = Uint32Array.from({ length: 256 }, (_, far) => // as an ImageData holds them
  0xff000000 + (far << 16) + ((255 - Math.abs(2 * far - 255)) << 8) + 255 - far);
const CLOCK_EVERY = 1000, CLOCK_KNOWN = 5000; // ms
const bytes = (view) => new Uint8Array(view.buffer, view.byteOffset, view.byteLength);

export class Sags {
  constructor(url = `ws://${location.host}/ws`, { maxAge = 0.4 } = {}) {
    Object.assign(this, { url, maxAge, topics: new Map(), waiting: new Map(), asked: 0, drawn: {}, reasons: {}, units: {} });
    this.forgetClock();
    this.connect();
    const look = () => { this.look(); requestAnimationFrame(look); }; // before each time the page is painted
    look();
    setInterval(() => {
      if (performance.now() - this.heardAt > CLOCK_KNOWN) this.socket.onclose(); // not even its clock comes: connect anew
      else this.askClock();
    }, CLOCK_EVERY);
  }

  show(topic, canvas) {
    const blank = () => canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    this.follow(topic, async (head, data) => {
      const picture = await decoded(head, data);
      return () => {
        const context = canvas.getContext("2d"), { width, height } = picture;
        if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
        if (picture instanceof ImageData) return context.putImageData(picture, 0, 0);
        context.drawImage(picture, 0, 0);
        picture.close();
      };
    }, blank);
  }

  anchors(topic, draw) { // draw([{id, u, v, x, y, z, visibility, confidence, ...}, ...])
    this.follow(topic, async (head, data) => () => draw(rows(head, data)), () => draw([]));
  }

  request(op, args = {}) { // resolves to the node's answer; get_clock, and with --pin add_anchor, remove_anchor
    if (this.socket.readyState !== WebSocket.OPEN) return Promise.reject(new Error("not connected"));
    const id = ++this.asked;
    this.socket.send(JSON.stringify({ id, op, args }));
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
  }

  // ---- what comes ------------------------------------------------------------------------------------------

  follow(topic, prepare, blank) {
    this.topics.set(topic, { prepare, blank, shownMs: null, newest: null, busy: false });
    if (this.socket.readyState === WebSocket.OPEN) this.subscribe();
  }

  connect() {
    this.socket = new WebSocket(this.url);
    this.socket.binaryType = "arraybuffer";
    this.heardAt = performance.now();
    this.socket.onopen = () => { this.subscribe(); this.askClock(); };
    this.socket.onmessage = ({ data }) => {
      this.heardAt = performance.now();
      if (typeof data === "string") this.heard(JSON.parse(data)); else this.came(data);
    };
    this.socket.onclose = () => {
      Object.assign(this.socket, { onopen: null, onmessage: null, onclose: null }); // one that hangs may close much later
      this.socket.close();
      this.heardAt = Infinity; // until it is connected anew
      for (const topic of this.topics.keys()) this.takeBack(topic, "no gateway");
      for (const { reject } of this.waiting.values()) reject(new Error("the connection was closed"));
      this.waiting.clear();
      this.forgetClock();
      setTimeout(() => this.connect(), 500);
    };
  }

  subscribe() { this.socket.send(JSON.stringify({ subscribe: [...this.topics.keys()] })); }

  heard(said) {
    if (this.topics.has(said.topic)) this.takeBack(said.topic, said.stale);
    else if (this.waiting.has(said.id)) {
      const { resolve, reject } = this.waiting.get(said.id);
      this.waiting.delete(said.id);
      if (said.ok) resolve(said.result); else reject(new Error(said.error));
    } else console.warn("sags:", said.error);
  }

  came(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const data = new DataView(buffer, 4 + length + head.parts[0], head.parts[1]); // the bulk: part 1
    const way = this.topics.get(head.topic);
    if (way === undefined) return;
    way.newest = { head, data };
    if (!way.busy) this.work(head.topic, way);
  }

  async work(topic, way) { // one at a time; what came meanwhile is left out but for the newest
    way.busy = true;
    while (way.newest !== null) {
      const { head, data } = way.newest;
      way.newest = null;
      const stampMs = head.stamp_ns / 1e6;
      try {
        const draw = await way.prepare(head, data);
        if (this.age(stampMs) > this.maxAge) continue;
        draw();
        way.shownMs = stampMs;
        this.units[topic] = head.units;
        this.drawn[topic] = (this.drawn[topic] ?? 0) + 1;
        delete this.reasons[topic];
      } catch (error) { this.takeBack(topic, String(error)); }
    }
    way.busy = false;
  }

  // ---- what must go ----------------------------------------------------------------------------------------

  look() {
    for (const [topic, way] of this.topics)
      if (way.shownMs !== null && this.age(way.shownMs) > this.maxAge) this.takeBack(topic, "too old");
  }

  takeBack(topic, reason) {
    const way = this.topics.get(topic);
    this.reasons[topic] = reason;
    Object.assign(way, { shownMs: null, newest: null });
    way.blank();
  }

  // ---- the node's clock: at most `received - asked` ahead of ours, as docs/wire.md says ----------------------

  age(stampMs) { // s, and rather too much than too little; infinite while the clock is not known
    const known = this.ahead.length > 0 && performance.now() - this.clockAt < CLOCK_KNOWN;
    return known ? (this.now() + Math.min(...this.ahead) - stampMs) / 1000 : Infinity;
  }

  now() { return performance.timeOrigin + performance.now(); } // ms; nobody sets it
  forgetClock() { Object.assign(this, { ahead: [], clockAt: -Infinity }); }

  async askClock() {
    const asked = this.now();
    try {
      const said = await this.request("get_clock");
      const least = said.answered_ns / 1e6 - this.now();
      this.ahead = this.ahead.filter((most) => most >= least).slice(-8); // others are of before it was set
      this.ahead.push(said.received_ns / 1e6 - asked);
      this.clockAt = performance.now();
    } catch { /* no connection: it is asked again */ }
  }
}

// ---- content -------------------------------------------------------------------------------------------------

function rows(head, data) { // of a PointCloud2
  const names = head.encoding.split(",");
  const row = (i) => Object.fromEntries(names.map((name, k) => {
    const at = 4 * (i * names.length + k);
    return [name, name === "id" ? data.getUint32(at, true) : data.getFloat32(at, true)];
  }));
  return Array.from({ length: head.shape[0] }, (_, i) => row(i));
}

async function decoded(head, data) { // ImageData, or an ImageBitmap
  if (head.type.endsWith("/CompressedImage"))
    return head.scale === undefined ? createImageBitmap(new Blob([bytes(data)])) : coloured(...(await png(head, data)));
  const [height, width] = head.shape;
  if (head.encoding === "32FC1") return coloured(new Float32Array(data.buffer, data.byteOffset, height * width), width);
  const pixels = new Uint8ClampedArray(data.buffer, data.byteOffset, data.byteLength);
  if (head.encoding === "rgba8") return new ImageData(pixels, width, height);
  const made = new ImageData(width, height), channels = head.encoding === "mono8" ? 1 : 3;
  for (let i = 0; i < width * height; i++) {
    for (let k = 0; k < 3; k++) made.data[4 * i + k] = pixels[channels * i + (channels === 1 ? 0 : k)];
    made.data[4 * i + 3] = 255;
  }
  return made;
}

function coloured(metres, width) { // unknown stays transparent; the numbers are not shown, only their order
  const made = new ImageData(width, metres.length / width), pixels = new Uint32Array(made.data.buffer);
  const steep = 255 / Math.log(FAR / NEAR);
  for (let i = 0; i < metres.length; i++)
    if (metres[i] > 0) pixels[i] = COLOURS[Math.min(Math.max(Math.round(steep * Math.log(metres[i] / NEAR)), 0), 255)];
  return made;
}

async function png(head, data) { // numbers of 8 or 16 bit, which browsers would make colours of
  const width = data.getUint32(16), step = data.getUint8(24) / 8, found = [];
  for (let at = 8; at < data.byteLength; at += 12 + data.getUint32(at))
    if (data.getUint32(at + 4) === 0x49444154) found.push(bytes(data).subarray(at + 8, at + 8 + data.getUint32(at)));
  const inflated = new Blob(found).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = new Uint8Array(await new Response(inflated).arrayBuffer());
  const length = width * step, height = raw.length / (length + 1), out = new Uint8Array(length * height);
  for (let y = 0; y < height; y++) {
    const filter = raw[y * (length + 1)], from = y * (length + 1) + 1, to = y * length;
    for (let x = 0; x < length; x++) {
      const a = x >= step ? out[to + x - step] : 0, b = y > 0 ? out[to + x - length] : 0;
      const c = x >= step && y > 0 ? out[to + x - length - step] : 0;
      const pa = Math.abs(b - c), pb = Math.abs(a - c), pc = Math.abs(a + b - 2 * c);
      const paeth = pa <= pb && pa <= pc ? a : pb <= pc ? b : c;
      out[to + x] = raw[from + x] + [0, a, b, (a + b) >> 1, paeth][filter];
    }
  }
  const numbers = new Float32Array(width * height);
  for (let i = 0; i < numbers.length; i++) numbers[i] = head.scale * (step === 2 ? 256 * out[2 * i] + out[2 * i + 1] : out[i]);
  return [numbers, width];
}
