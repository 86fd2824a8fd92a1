"use strict";
// Labels of vehicles, put into a user's own frames by hand.
(() => {
  const TAIL = 8, STEP_MS = 250, NEAR_PX = 12, DECIMALS = 3, MAX_PX = 8192;
  const byId = (id) => document.getElementById(id);
  const { times_s, extent_m, pictures, columns } = JSON.parse(byId("data").textContent);
  const [west, south, east, north] = extent_m, shape = (north - south) / (east - west);
  const canvas = byId("canvas"), slider = byId("frame"), play = byId("play"), choice = byId("vehicle");
  const vehicles = new Map(); // id: Map of frame to [x, y, asked], shares of the picture
  let timer = null, chosen = 1, changed = false;
  const images = pictures.map((text) => {
    const image = new Image();
    image.onload = draw;
    image.src = `data:image/jpeg;base64,${text}`;
    return image;
  });
  const frame = () => Number(slider.value);
  const points = (ident) => vehicles.get(ident) || new Map();

  function draw() {
    const k = frame(), image = images[k], zoom = Number(byId("zoom").value), ratio = window.devicePixelRatio || 1;
    const own = image && image.naturalWidth ? image.naturalWidth : 600;
    const width = zoom ? Math.min(own * zoom, MAX_PX) / ratio : byId("view").clientWidth;
    canvas.style.width = `${width}px`;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(canvas.width * shape);
    const ctx = canvas.getContext("2d"), x = (p) => p[0] * canvas.width, y = (p) => p[1] * canvas.height;
    ctx.imageSmoothingEnabled = !zoom || zoom === 1;
    if (image && image.complete && image.naturalWidth) ctx.drawImage(image, 0, 0, canvas.width, canvas.height);
    ctx.font = `${12 * ratio}px sans-serif`;
    let here = 0;
    for (const [ident, rows] of vehicles) {
      const tail = [...rows.keys()].filter((at) => at <= k && at >= k - TAIL).sort((a, b) => a - b);
      ctx.strokeStyle = ctx.fillStyle = `hsl(${(ident * 137) % 360} 90% 65%)`;
      ctx.lineWidth = (ident === chosen ? 2.5 : 1.2) * ratio;
      ctx.beginPath();
      for (const at of tail) ctx.lineTo(x(rows.get(at)), y(rows.get(at)));
      ctx.stroke();
      const now = rows.get(k) || (ident === chosen && predict(rows, k));
      if (!now) continue;
      ctx.beginPath();
      if (rows.has(k)) {
        here += 1;
        ctx.arc(x(now), y(now), 6 * ratio, 0, 2 * Math.PI);
        ctx.fillText(ident, x(now) + 8 * ratio, y(now) - 6 * ratio);
      } else {
        const arm = 5 * ratio;
        ctx.moveTo(x(now) - arm, y(now)); ctx.lineTo(x(now) + arm, y(now));
        ctx.moveTo(x(now), y(now) - arm); ctx.lineTo(x(now), y(now) + arm);
      }
      ctx.stroke();
    }
    byId("time").textContent = `${k + 1} of ${times_s.length}, ${times_s[k].toFixed(2)} s`;
    byId("vehicles").textContent = [...vehicles.values()].filter((rows) => rows.size).length;
    byId("points").textContent = [...vehicles.values()].reduce((sum, rows) => sum + rows.size, 0);
    byId("here").textContent = here;
  }
  function predict(rows, k) { // at constant velocity from the two labels before
    const [b, a] = [...rows.keys()].filter((at) => at < k).sort((p, q) => q - p);
    if (b === undefined) return null;
    const last = rows.get(b);
    if (a === undefined) return last;
    const part = (times_s[k] - times_s[b]) / (times_s[b] - times_s[a]), before = rows.get(a);
    return [0, 1].map((i) => last[i] + part * (last[i] - before[i]));
  }
  function choose(ident) {
    chosen = ident;
    if (!vehicles.has(ident)) vehicles.set(ident, new Map());
    const known = [...vehicles.keys()].sort((a, b) => a - b);
    choice.replaceChildren(...known.map((one) => new Option(one, one, false, one === chosen)));
    draw();
  }
  function step(by) {
    slider.value = frame() + by;
    draw();
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  function toggle() {
    if (timer) return stop();
    play.textContent = "Pause";
    timer = setInterval(() => {
      slider.value = (frame() + 1) % times_s.length;
      draw();
    }, STEP_MS);
  }
  function remove() {
    changed = points(chosen).delete(frame()) || changed;
    draw();
  }
  function text() {
    const lines = [];
    for (const [ident, rows] of vehicles)
      for (const [k, [x, y, asked = 1]] of rows)
        lines.push([times_s[k], ident, (west + x * (east - west)).toFixed(DECIMALS), (north - y * (north - south)).toFixed(DECIMALS), k, asked]);
    lines.sort((a, b) => a[4] - b[4] || a[1] - b[1]);
    return [columns, ...lines].map((line) => line.join(",") + "\n").join("");
  }
  function read(content) {
    const [head, ...lines] = content.trim().split(/\r?\n/).map((line) => line.split(","));
    if (head.join() !== columns.join()) return say(`The file must have the columns ${columns.join(", ")}.`);
    const rows = lines.map((line) => line.map(Number));
    const wrong = rows.find((row) => row.length !== columns.length || !row.every(Number.isFinite) || times_s[row[4]] !== row[0]);
    if (wrong) return say("The file must have labels of these frames: a row has another time or no number.");
    vehicles.clear();
    for (const [, ident, x, y, k, asked] of rows) {
      if (!vehicles.has(ident)) vehicles.set(ident, new Map());
      vehicles.get(ident).set(k, [(x - west) / (east - west), (north - y) / (north - south), asked]);
    }
    choose(rows.length ? rows[0][1] : 1);
    say(`${rows.length} labels were read.`);
  }
  function say(message) {
    byId("said").textContent = message;
    byId("said").hidden = false;
  }
  canvas.addEventListener("click", (event) => {
    const box = canvas.getBoundingClientRect();
    const at = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    if (event.shiftKey) {
      const away = (rows) => rows.has(frame()) ? Math.hypot((rows.get(frame())[0] - at[0]) * box.width, (rows.get(frame())[1] - at[1]) * box.height) : Infinity;
      const [near] = [...vehicles].sort((a, b) => away(a[1]) - away(b[1]));
      return near && away(near[1]) <= NEAR_PX ? choose(near[0]) : undefined;
    }
    stop();
    points(chosen).set(frame(), at);
    changed = true;
    if (byId("advance").checked) step(1); else draw();
  });
  byId("save").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text()], { type: "text/csv" }));
    link.download = "labels.csv";
    link.click();
    URL.revokeObjectURL(link.href);
    changed = false;
  });
  byId("load").addEventListener("change", (event) => {
    const [file] = event.target.files;
    if (file) file.text().then(read);
  });
  const add = () => choose(Math.max(0, ...vehicles.keys()) + 1);
  byId("new").addEventListener("click", add);
  byId("remove").addEventListener("click", remove);
  byId("back").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  play.addEventListener("click", toggle);
  choice.addEventListener("change", () => choose(Number(choice.value)));
  slider.addEventListener("input", draw);
  byId("zoom").addEventListener("change", draw);
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
    const keys = { ArrowLeft: () => step(-1), ArrowRight: () => step(1), n: add, Delete: remove, " ": toggle };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  window.addEventListener("beforeunload", (event) => { if (changed) event.preventDefault(); });
  new ResizeObserver(draw).observe(byId("view"));
  theme.start(draw);
  choose(1);
})();
