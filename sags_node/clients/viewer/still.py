"""The page covers itself when nothing comes from here: it alone knows that a link, or this process, hangs.

In a corner it says how many frames a second come to it. What stays longer than `OLD_AFTER`, as the page or
machine is slow, gets a rim, and the corner says since when.
"""

SILENT_AFTER = 6.0  # s; an update by `run` takes 5.3 s where images come late and the browser is slow
RATE_OVER = 2.0  # s
OLD_AFTER = 2.0  # s; somebody may choose one update a second
# Runs in the page, before viser. The status comes every second, also to a page that has folded it away: it is
# heard where viser's own thread hands it over, with the capture time of what is shown. A page that was busy
# itself gets a second look.
SCRIPT = """<script>
(() => {
  let since = null, looks = 0, shown = "0", there = false, recent = [];
  const came = window.sagsFrames = { count: 0 };  // of all, and `first` and `last`, ms
  const frame = ({ updates }) => /data-frame="(\\d+)"/.exec(updates?.content)?.[1];
  const hear = ({ data }) => {
    if (data?.type !== "message_batch") return;
    const told = data.messages.map(frame).filter(Boolean), now = performance.now();
    if (since !== null && !told.length) return;
    [since, looks] = [now, 0];
    for (const each of told) {
      there = each !== "0";
      if (!there || each === shown) continue;
      [shown, came.last] = [each, now];
      came.first ??= now;
      came.count++;
      recent.push(now);
    }
  };
  window.Worker = class extends Worker {
    constructor(...said) { super(...said); this.addEventListener("message", hear); }
  };
  const cover = document.createElement("div");
  cover.id = "sags-still";
  cover.style = "position:fixed;inset:0;z-index:99999;padding:2em;background:#111;color:#ff922b";
  const rate = document.createElement("div");
  rate.id = "sags-rate";
  rate.style = "position:fixed;left:8px;bottom:4px;font:12px sans-serif;color:#8b949e;pointer-events:none";
  const rim = document.createElement("style");
  rim.textContent = "[data-old] :is(img, canvas) { outline: 3px solid #ff922b; outline-offset: -3px }";
  document.head.append(rim);
  setInterval(() => {
    recent = recent.filter((each) => each > performance.now() - 1000 * RATE_OVER);
    const old = there ? (performance.now() - came.last) / 1000 : 0, still = old > OLD_AFTER;
    rate.textContent = `${Math.round(recent.length / RATE_OVER)} /s`
      + (still ? `: what you see came ${old.toFixed(0)} s ago` : "");
    document.documentElement.toggleAttribute("data-old", still);
    if (!rate.isConnected) document.body.append(rate);
    const silent = since === null ? 0 : (performance.now() - since) / 1000;
    if (silent < SILENT_AFTER || ++looks < 2) return cover.remove();
    cover.textContent = `no word from sags view for ${silent.toFixed(0)} s: what was here is old. `
      + "Start it again, or mend the link to it: the page comes back by itself";
    if (!cover.isConnected) document.body.append(cover);
  }, 250);
})();
</script>"""
for name, value in (("SILENT_AFTER", SILENT_AFTER), ("RATE_OVER", RATE_OVER), ("OLD_AFTER", OLD_AFTER)):
    SCRIPT = SCRIPT.replace(name, str(value))
