"""The page covers itself when nothing comes from here: it alone knows that a link, or this process, hangs."""

SILENT_AFTER = 6.0  # s; an update by `run` takes 5.3 s where images come late and the browser is slow
# Runs in the page, before viser. Its status comes every second, also to a page that has folded it away: it is
# heard where viser's own thread hands it over. A page that was busy itself gets a second look.
SCRIPT = """<script>
(() => {
  let since = null, looks = 0;
  const isStatus = ({ updates }) => String(updates?.content).includes("sags-status");
  const hear = ({ data }) => {
    if (data?.type !== "message_batch" || (since !== null && !data.messages.some(isStatus))) return;
    [since, looks] = [performance.now(), 0];
  };
  window.Worker = class extends Worker {
    constructor(...said) { super(...said); this.addEventListener("message", hear); }
  };
  const cover = document.createElement("div");
  cover.id = "sags-still";
  cover.style = "position:fixed;inset:0;z-index:99999;padding:2em;background:#111;color:#ff922b";
  setInterval(() => {
    const silent = since === null ? 0 : (performance.now() - since) / 1000;
    if (silent < SILENT_AFTER || ++looks < 2) return cover.remove();
    cover.textContent = `no word from sags view for ${silent.toFixed(0)} s: what was here is old. `
      + "Start it again, or mend the link to it: the page comes back by itself";
    if (!cover.isConnected) document.body.append(cover);
  }, 250);
})();
</script>""".replace("SILENT_AFTER", str(SILENT_AFTER))
