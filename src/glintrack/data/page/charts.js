"use strict";
// Curves by uPlot: against time with a marker at the film's time, or against wavelength.
const charts = (() => {
  const drawn = [];
  const DASHES = { pan: [], dolp: [7, 4], all: [2, 3] };
  const dashed = (dash) => (!dash || !dash.length ? "solid" : dash[0] > 3 ? "dashed" : "dotted"); // in the legend
  const channelColour = (name) => page.colour(`--${name}`) || page.colour("--text");

  function axis(label, size) {
    return {
      label, size, labelSize: 20, stroke: () => page.colour("--text"), font: "12px system-ui, sans-serif",
      labelFont: "12px system-ui, sans-serif", grid: { stroke: () => page.colour("--grid"), width: 1 },
      ticks: { stroke: () => page.colour("--grid"), width: 1 },
    };
  }

  function marker(u) {
    if (!page.times) return;
    const x = u.valToPos(page.data.times_s[page.state.t], "x", true);
    u.ctx.save();
    u.ctx.setLineDash([]);
    u.ctx.strokeStyle = page.colour("--marker");
    u.ctx.lineWidth = 1.5 * devicePixelRatio;
    u.ctx.beginPath();
    u.ctx.moveTo(x, u.bbox.top);
    u.ctx.lineTo(x, u.bbox.top + u.bbox.height);
    u.ctx.stroke();
    u.ctx.restore();
  }

  // without data that differ uPlot takes 0 to 100
  const around = (low, high) => (low < high ? uPlot.rangeNum(low, high, 0.1, true) : low === null ? [0, 1] : [Math.min(0, low), Math.max(1, 1.1 * low)]);
  const shown = (u, value) => (value === null || value === undefined ? "" : String(Number(value.toPrecision(4)))); // under the cursor
  const NEGLIGIBLE = 1e-9; // rounding, in any unit that is drawn here

  // series: [{label, values, colour(), dash, width, band}], x: numbers
  function draw(parent, { title, x, xlabel, ylabel, series, limits, timed, height = 210, bands }) {
    const figure = page.element("figure", { className: "chart" }, page.element("figcaption", { textContent: title }));
    const box = page.element("div", { role: "img" });
    const means = series.filter((s) => s.label).map((s) => {
      const v = s.values.filter((a) => a !== null);
      return `${s.label} ${v.length ? `from ${Math.min(...v).toPrecision(3)} to ${Math.max(...v).toPrecision(3)}` : "no data"}`;
    });
    box.setAttribute("aria-label", `${title}: ${means.join("; ")}`);
    figure.append(box);
    parent.append(figure);
    const make = () => {
      box.replaceChildren();
      const width = Math.max(200, box.clientWidth);
      const u = new uPlot({
        width, height, bands,
        cursor: { drag: { x: false, y: false } },
        legend: { live: width > 400, markers: { width: 2, fill: () => "transparent", dash: (_, i) => dashed(series[i - 1] && series[i - 1].dash) } },
        scales: { x: { time: false }, y: { range: limits || ((u, low, high) => around(low, high)) } },
        axes: [axis(xlabel, 46), axis(ylabel, 58)],
        series: [{ label: xlabel, value: shown }, ...series.map((s) => ({
          label: s.label, value: shown, stroke: s.colour, dash: s.dash, width: s.width || 1.8, spanGaps: false,
          fill: s.fill, points: { show: s.values.filter((a) => a !== null).length < 3 },
        }))],
        hooks: timed ? { draw: [marker] } : {},
      }, [x, ...series.map((s) => s.values)], box);
      if (timed) u.over.addEventListener("click", () => {
        const at = u.posToVal(u.cursor.left, "x");
        let best = 0;
        page.data.times_s.forEach((t, k) => { if (Math.abs(t - at) < Math.abs(page.data.times_s[best] - at)) best = k; });
        page.setTime(best);
      });
      return u;
    };
    const entry = { u: make(), make, box, timed, figure };
    drawn.push(entry);
    watcher.observe(box);
    return entry;
  }

  const watcher = new ResizeObserver((entries) => entries.forEach(({ target }) => {
    const one = drawn.find((d) => d.box === target);
    const width = Math.max(200, target.clientWidth);
    if (one && Math.abs(one.u.width - width) > 1) one.u.setSize({ width, height: one.u.height });
  }));

  function clear(parent) {
    for (let i = drawn.length - 1; i >= 0; i--)
      if (parent.contains(drawn[i].figure)) {
        watcher.unobserve(drawn[i].box);
        drawn[i].u.destroy();
        drawn.splice(i, 1);
      }
    parent.replaceChildren();
  }

  let queued = false;
  const redraw = () => {
    if (queued) return;
    queued = true;
    requestAnimationFrame(() => { queued = false; drawn.filter((d) => d.timed).forEach((d) => d.u.redraw(false)); });
  };
  const start = () => {
    page.on("time", redraw);
    page.on("theme", () => drawn.forEach((d) => { d.u.destroy(); d.u = d.make(); }));
  };

  function overTime(parent, title, ylabel, pick, limits, only = Object.keys(page.channels)) {
    const series = only.filter((name) => pick(page.channels[name])).map((name) => ({
      label: page.named(name), values: pick(page.channels[name]), colour: () => channelColour(name), dash: DASHES[name],
    }));
    if (series.some((s) => s.values.some((v) => v !== null)))
      draw(parent, { title, x: page.data.times_s.slice(0, series[0].values.length), xlabel: "time [s]", ylabel, series, limits, timed: true });
  }

  function scores() {
    if (!page.byId("score-charts")) return;
    const parent = page.byId("score-charts"), curve = (k) => (m) => m.curves[k];
    overTime(parent, "Track completeness, Eq. (13)", "completeness", curve("completeness"), [0, 1.02]);
    overTime(parent, "Track purity of the flight so far, Eq. (14)", "purity", curve("purity"), [0, 1.02]);
    overTime(parent, "Vehicles with a track", "vehicles", curve("valid"));
    overTime(parent, "False tracks", "tracks", curve("false_tracks"));
    overTime(parent, "Spectra served", "queries", curve("queries_served"));
    const swept = Object.entries(page.channels).filter(([, m]) => m.froc);
    if (swept.length && page.byId("froc-charts")) plots.draw(page.byId("froc-charts"), [{
      title: "FROC: completeness against false tracks; large open mark: this run", xlabel: "false tracks per frame", ylabel: "completeness", fromZero: true,
      lines: swept.map(([name, { froc }]) => ({ label: page.named(name), channel: name, points: froc.points, joined: froc.points, own: froc.own })),
    }]);
  }

  const QUALITY = {
    rmse: "Picture: RMS error", psnr: "Picture: PSNR", ssim: "Picture: structural similarity", snr: "Picture: SNR",
    mtf_quarter: "Picture: MTF at 0.25 cycles per pixel", dolp_rmse: "Polarization: RMS error of DoLP",
    aop_rmse: "Polarization: RMS error of AoP", registration_error: "Registration error on the ground",
    registration_error_px: "Registration error in the frame", spectral_angle: "Spectra: mean spectral angle",
    spectral_rmse: "Spectra: RMS error",
  };
  function quality() {
    if (!page.byId("quality-charts")) return;
    const parent = page.byId("quality-charts"), found = Object.values(page.channels).map((m) => m.quality);
    const names = [...new Set(found.flatMap(Object.keys))];
    for (const name of names) {
      const units = found.map((q) => q[name]).filter(Boolean)[0].units;
      const values = (m) => m.quality[name] && m.quality[name].values.map((v) => (v !== null && Math.abs(v) < NEGLIGIBLE ? 0 : v));
      overTime(parent, QUALITY[name] || name, units === "1" ? "" : units, values);
    }
  }

  return { draw, clear, start, scores, quality, channelColour };
})();
