"use strict";
// The pictures of the flight, in sync, with tracks, truth and queries drawn over them.
const film = (() => {
  const KINDS = {
    rgb: ["natural colour", ""], pan: ["pan radiance", "gray"], dolp: ["DoLP (degree of polarization)", "viridis"],
    aop: ["AoP (angle of polarization)", "shifted"], map: ["map", ""],
  };
  const GRADIENTS = {
    gray: ["#000", "#fff"],
    viridis: ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"],
    shifted: ["#301437", "#5e45a6", "#7ca2c2", "#e2d9e2", "#c6896c", "#8d2b50", "#301338"], // matplotlib's twilight_shifted
  };
  const { data, state } = page;
  const info = data.film || {};
  const kinds = info.kinds && info.kinds.length ? info.kinds : ["map"];
  const [west, south, east, north] = data.extent_m;
  const wide = 10 * (east - west), high = 10 * (north - south); // rows are in decimetres from the middle
  const TAIL_S = 8, HIT_PX = 14;
  const panels = {};
  const cache = new Map();
  let pictures = null;

  function ends(kind) {
    if (kind === "pan") return info.pan_range.map((v) => v.toPrecision(3)).concat("W m⁻² sr⁻¹ µm⁻¹");
    if (kind === "dolp") return ["0", String(info.dolp_highest), ""];
    return ["0°", "180°", info.aop_full_dolp ? `, brightness: DoLP 0 to ${info.aop_full_dolp}` : ""];
  }

  function build() {
    pictures = page.read("pictures");
    for (const kind of kinds) {
      state.kinds[kind] = true;
      const caption = page.element("figcaption", {}, page.element("span", { textContent: KINDS[kind][0] }));
      const map = GRADIENTS[KINDS[kind][1]];
      if (map) {
        const [low, top, unit] = ends(kind);
        const bar = page.element("span", { className: "gradient" });
        bar.style.background = `linear-gradient(to right, ${map.join(",")})`;
        caption.append(page.element("span", { className: "scale" }, low, bar, `${top}${unit.startsWith(",") ? "" : " "}${unit}`));
      }
      const canvas = page.element("canvas", { role: "img" });
      canvas.setAttribute("aria-label", `${KINDS[kind][0]} of the ground with the chosen layers`);
      canvas.dataset.kind = kind;
      const figure = page.element("figure", { className: "panel" }, caption, canvas);
      page.byId("panels").append(figure);
      panels[kind] = { canvas, figure };
      handle(canvas);
      new ResizeObserver(queue).observe(canvas);
    }
    page.on("time", queue);
    page.on("look", queue);
    page.on("channel", queue);
    page.on("theme", queue);
    queue();
  }

  // index into the film of the frame shown at a time: the last one not later
  function frameAt(t) {
    let k = 0;
    while (k + 1 < info.times_s.length && info.times_s[k + 1] <= data.times_s[t] + 1e-6) k++;
    return k;
  }
  function picture(kind, k) {
    const key = `${kind} ${k}`;
    if (cache.has(key)) return cache.get(key);
    const inline = pictures[kind];
    if (inline && !inline[k]) return null;
    const image = new Image();
    image.onload = queue;
    image.src = inline ? `data:image/webp;base64,${inline[k]}`
      : `film/${kind}_${String(info.frames[k]).padStart(5, "0")}.webp`;
    cache.set(key, image);
    if (cache.size > 160) cache.delete(cache.keys().next().value);
    return image;
  }

  let queued = false;
  function queue() {
    if (queued) return;
    queued = true;
    requestAnimationFrame(() => { queued = false; drawAll(); });
  }
  function drawAll() {
    for (const kind of kinds) {
      panels[kind].figure.hidden = !state.kinds[kind];
      if (state.kinds[kind]) draw(kind);
    }
    say();
  }

  function transform(canvas) {
    const scale = state.zoom * Math.min(canvas.width / wide, canvas.height / high);
    return {
      scale,
      x: (x) => canvas.width / 2 + (x - state.cx) * scale,
      y: (y) => canvas.height / 2 - (y - state.cy) * scale,
    };
  }

  function draw(kind) {
    const panel = panels[kind], canvas = panel.canvas, ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientWidth * ratio * high / wide);
    if (!width) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const ctx = canvas.getContext("2d"), at = transform(canvas);
    ctx.fillStyle = "#606874";
    ctx.fillRect(0, 0, width, height);
    if (kind !== "map") {
      const image = picture(kind, frameAt(state.t));
      if (image && image.complete && image.naturalWidth) panel.last = image;
      if (panel.last) {
        ctx.imageSmoothingEnabled = state.zoom < 3;
        ctx.drawImage(panel.last, at.x(-wide / 2), at.y(high / 2), wide * at.scale, high * at.scale);
      }
      const next = frameAt(Math.min(state.t + 1, page.times - 1));
      if (state.playing) picture(kind, next);
    }
    ctx.lineJoin = "round";
    overlay(ctx, at, ratio);
    bearings(ctx, at, ratio, width, height);
    canvas.dataset.frame = state.t;
  }

  const STEPS = [1, 2, 5];
  // the longest of 1, 2, 5, 10, 20 … metres that takes no more than a quarter of the picture
  function roundLength(most) {
    const power = 10 ** Math.floor(Math.log10(most));
    return Math.max(...STEPS.map((s) => s * power).filter((v) => v <= most * (1 + 1e-9)));
  }

  // north, the sun's direction and a scale bar, in white over black
  function bearings(ctx, at, ratio, width, height) {
    const perMetre = 10 * at.scale, length = roundLength((0.25 * width) / perMetre), bar = length * perMetre;
    const pad = 12 * ratio, arrow = 15 * ratio, size = 11 * ratio;
    const both = (draw) => [["rgba(0,0,0,.75)", 4.4], ["#fff", 1.8]].forEach(([colour, w]) => {
      ctx.strokeStyle = colour; ctx.fillStyle = colour; ctx.lineWidth = w * ratio; draw(colour === "#fff");
    });
    ctx.font = `600 ${size}px system-ui, sans-serif`;
    const say = (text, x, y, top) => (top ? ctx.fillText(text, x, y) : ctx.strokeText(text, x, y));
    both((top) => {
      const y = height - pad, x = pad;
      ctx.beginPath(); ctx.moveTo(x, y - 5 * ratio); ctx.lineTo(x, y); ctx.lineTo(x + bar, y); ctx.lineTo(x + bar, y - 5 * ratio); ctx.stroke();
      ctx.textAlign = "left"; say(`${length} m`, x + bar + 6 * ratio, y, top);
      const nx = pad + 4 * ratio, ny = pad;
      ctx.beginPath(); ctx.moveTo(nx, ny + arrow); ctx.lineTo(nx, ny); ctx.moveTo(nx - 4 * ratio, ny + 6 * ratio); ctx.lineTo(nx, ny); ctx.lineTo(nx + 4 * ratio, ny + 6 * ratio); ctx.stroke();
      ctx.textAlign = "center"; say("N", nx, ny + arrow + size, top);
      if (data.sun_azimuth_deg === null) return;
      const towards = (data.sun_azimuth_deg * Math.PI) / 180, sx = pad + 46 * ratio, sy = ny + arrow / 2 + 3 * ratio;
      const tip = [sx + arrow * Math.sin(towards), sy - arrow * Math.cos(towards)];
      ctx.beginPath(); ctx.moveTo(sx, sy); ctx.lineTo(...tip); ctx.stroke();
      if (top) ctx.fillStyle = "#ffd94a";
      ctx.beginPath(); ctx.arc(...tip, (top ? 4 : 5.2) * ratio, 0, 2 * Math.PI); ctx.fill();
      if (top) ctx.fillStyle = "#fff";
      say("sun", sx, Math.max(ny + arrow, Math.max(sy, tip[1]) + 6 * ratio) + size, top);  // below its disc
    });
    ctx.textAlign = "start";
  }

  const each = (rows, t, f) => { for (let i = rows.begin[t]; i < rows.begin[t + 1]; i++) f(i); };

  // safe for colour-blind eyes (Okabe and Ito); the shape says the same; as the legend in page.css
  const MARKS = { true: "#56b4e9", coast: "#f0e442", false: "#ff8a3d", other: "#d9dde2", missed: "#ff9fd2", hidden: "#e3e6ea" };

  function stroke(ctx, colour, width, ratio, dash = []) {
    // a dark line below keeps marks legible on light and dark ground
    ctx.setLineDash(dash.map((d) => d * ratio));
    ctx.strokeStyle = "rgba(0,0,0,.65)";
    ctx.lineWidth = (width + 1.6) * ratio;
    ctx.stroke();
    ctx.strokeStyle = colour;
    ctx.lineWidth = width * ratio;
    ctx.stroke();
    ctx.setLineDash([]);
  }

  function overlay(ctx, at, ratio) {
    if (!page.times) return;
    const { layers, t } = state, shown = page.shown(), r = 5 * ratio;
    const tracked = new Set(); // vehicles with a true track at this time
    each(shown.tracks, t, (i) => { if (shown.tracks.flags[i] & 2) tracked.add(shown.tracks.vehicle[i]); });
    if (layers.truth) each(page.truth, t, (i) => {
      if (!(page.truth.flags[i] & 1) || tracked.has(page.truth.id[i])) return;
      const x = at.x(page.truth.x[i]), y = at.y(page.truth.y[i]), seen = page.truth.flags[i] & 2, s = (seen ? 0.7 : 0.5) * r;
      ctx.beginPath();
      ctx.moveTo(x - s, y - s); ctx.lineTo(x + s, y + s); ctx.moveTo(x - s, y + s); ctx.lineTo(x + s, y - s);
      stroke(ctx, seen ? MARKS.missed : MARKS.hidden, seen ? 1.6 : 0.7, ratio);
    });
    if (layers.queries) each(shown.queries, t, (i) => {
      ctx.beginPath();
      ctx.rect(at.x(shown.queries.x[i]) - 1.3 * r, at.y(shown.queries.y[i]) - 1.3 * r, 2.6 * r, 2.6 * r);
      stroke(ctx, "#ff6fb1", 1, ratio);
    });
    const rows = shown.tracks;
    taken = [];
    each(rows, t, (i) => track(ctx, at, ratio, rows, i, r));
  }

  function track(ctx, at, ratio, rows, i, r) {
    const { layers } = state, chosen = rows.id[i] === state.track;
    const coasted = rows.flags[i] & 1, isTrue = rows.flags[i] & 2, isFalse = rows.flags[i] & 4, x = at.x(rows.x[i]), y = at.y(rows.y[i]);
    const colour = isFalse ? MARKS.false : !isTrue ? MARKS.other : coasted ? MARKS.coast : MARKS.true;
    if (layers.tails || chosen) {
      const mine = rows.of.get(rows.id[i]), now = data.times_s[rows.t[i]];
      ctx.beginPath();
      for (const j of mine) {
        if (rows.t[j] > rows.t[i] || (now - data.times_s[rows.t[j]] > TAIL_S && !chosen)) continue;
        ctx.lineTo(at.x(rows.x[j]), at.y(rows.y[j]));
      }
      stroke(ctx, colour, 0.9, ratio);
    }
    if (layers.predictions) {
      ctx.beginPath();
      ctx.moveTo(x, y);
      ctx.lineTo(at.x(rows.x[i] + rows.vx[i] / 10), at.y(rows.y[i] + rows.vy[i] / 10));
      stroke(ctx, "#ffffff", 1, ratio);
    }
    if (layers.tracks || chosen) {
      const dash = coasted ? [3, 2] : [], s = 1.15 * r;
      ctx.beginPath();
      if (isFalse) { ctx.moveTo(x, y - s); ctx.lineTo(x + s, y + 0.85 * s); ctx.lineTo(x - s, y + 0.85 * s); ctx.closePath(); }
      else if (isTrue && coasted) { ctx.moveTo(x, y - s); ctx.lineTo(x + s, y); ctx.lineTo(x, y + s); ctx.lineTo(x - s, y); ctx.closePath(); }
      else ctx.arc(x, y, isTrue ? r : 0.75 * r, 0, 2 * Math.PI);
      stroke(ctx, colour, isTrue || isFalse ? 1.7 : 1, ratio, dash);
      if (chosen) {
        ctx.beginPath();
        ctx.arc(x, y, 1.8 * r, 0, 2 * Math.PI);
        stroke(ctx, "#ffffff", 2.4, ratio);
      }
    }
    if (layers.ids || chosen) label(ctx, ratio, rows.id[i], x + 1.4 * r, y - r, colour, chosen);
  }

  let taken = []; // where ids stand in the picture being drawn
  function label(ctx, ratio, text, x, y, colour, chosen) {
    const size = Math.round(10 * ratio);
    ctx.font = `${chosen ? "bold " : ""}${size}px system-ui, sans-serif`;
    const box = [x, y - size, x + ctx.measureText(text).width, y];
    if (!chosen && taken.some((o) => box[0] < o[2] && o[0] < box[2] && box[1] < o[3] && o[1] < box[3])) return;
    taken.push(box);
    ctx.lineWidth = 3 * ratio;
    ctx.strokeStyle = "rgba(0,0,0,.75)";
    ctx.fillStyle = colour;
    ctx.strokeText(text, x, y);
    ctx.fillText(text, x, y);
  }

  function say() {
    const shown = page.shown(), t = state.t;
    let moving = 0;
    if (page.times) each(page.truth, t, (i) => { moving += page.truth.flags[i] & 1; });
    const count = (rows) => (page.times ? rows.begin[t + 1] - rows.begin[t] : 0);
    page.byId("clock").textContent = page.seconds(t);
    page.byId("now").textContent = page.times
      ? `At ${page.seconds(t)}: ${count(shown.tracks)} tracks in ${page.named(state.channel) || "no channel"}, ` +
        `${moving} moving vehicles inside, ${count(shown.queries)} spectra.`
      : "There are no frames to show.";
  }

  function nearest(canvas, event) {
    const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width, at = transform(canvas);
    const px = (event.clientX - box.left) * ratio, py = (event.clientY - box.top) * ratio;
    const rows = page.shown().tracks;
    let best = null, least = HIT_PX * ratio;
    if (rows.count) each(rows, state.t, (i) => {
      const d = Math.hypot(at.x(rows.x[i]) - px, at.y(rows.y[i]) - py);
      if (d < least) { least = d; best = rows.id[i]; }
    });
    return best;
  }

  function zoom(factor) {
    state.zoom = Math.max(1, Math.min(24, state.zoom * factor));
    clampView();
  }
  function clampView() {
    const roomX = 0.5 * wide * (1 - 1 / state.zoom), roomY = 0.5 * high * (1 - 1 / state.zoom);
    state.cx = Math.max(-roomX, Math.min(roomX, state.cx));
    state.cy = Math.max(-roomY, Math.min(roomY, state.cy));
    page.notify("look");
  }
  function whole() { state.zoom = 1; state.cx = state.cy = 0; page.notify("look"); }

  function handle(canvas) {
    let from = null;
    canvas.addEventListener("pointerdown", (e) => { from = { x: e.clientX, y: e.clientY, moved: false }; });
    canvas.addEventListener("pointermove", (e) => {
      if (!from || !e.buttons) return;
      const dx = e.clientX - from.x, dy = e.clientY - from.y;
      if (!from.moved && Math.hypot(dx, dy) < 5) return;
      from.moved = true;
      const scale = transform(canvas).scale / (canvas.width / canvas.clientWidth);
      state.cx -= dx / scale; state.cy += dy / scale;
      from.x = e.clientX; from.y = e.clientY;
      clampView();
    });
    canvas.addEventListener("pointerup", (e) => {
      if (from && !from.moved) page.setTrack(nearest(canvas, e));
      from = null;
    });
    canvas.addEventListener("pointerleave", () => { from = null; });
    canvas.addEventListener("wheel", (e) => {
      if (!e.ctrlKey) return; // a plain wheel scrolls the page
      e.preventDefault();
      zoom(e.deltaY < 0 ? 1.25 : 0.8);
    }, { passive: false });
  }

  return { build, zoom, whole, kinds, names: KINDS, places: (kind) => transform(panels[kind].canvas), panels };
})();
