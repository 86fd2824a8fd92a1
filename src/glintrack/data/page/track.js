"use strict";
// One track: its life line, its identity switches and its spectra against the mean of a paint.
const tracks = (() => {
  const { state, data } = page;
  const { svg } = plots;

  const paintOf = (vehicle) => data.vehicles[vehicle] || "";
  const called = (vehicle) => (vehicle < 0 ? "no vehicle" : `vehicle ${vehicle}${paintOf(vehicle) ? ` (${paintOf(vehicle)})` : ""}`);

  const frames = (n) => `${n} ${n === 1 ? "frame" : "frames"}`;

  function fillChoices() {
    const choice = page.byId("track"), rows = page.shown().tracks;
    const ids = [...rows.of.keys()].sort((a, b) => a - b);
    choice.replaceChildren(page.element("option", { value: "", textContent: `none of ${ids.length}` }));
    for (const id of ids) {
      const mine = rows.of.get(id);
      const length = data.times_s[rows.t[mine[mine.length - 1]]] - data.times_s[rows.t[mine[0]]];
      choice.append(page.element("option", { value: id, textContent: `${id} (${length.toFixed(1)} s)` }));
    }
    const classes = Object.keys((page.shown().spectra || {}).classes || {});
    const select = page.byId("class");
    select.replaceChildren(page.element("option", { value: "", textContent: "its vehicle's paint" }));
    classes.forEach((name) => select.append(page.element("option", { value: name, textContent: name })));
  }

  // stretches of one vehicle: [{vehicle, from, to}] in indices of rows
  function stretches(rows, mine) {
    const out = [];
    for (const i of mine) {
      const last = out[out.length - 1];
      if (last && last.vehicle === rows.vehicle[i]) last.to = i;
      else out.push({ vehicle: rows.vehicle[i], from: i, to: i });
    }
    return out;
  }
  // where the track moves to another vehicle than the one it was last on
  function switches(parts) {
    const out = [];
    let last = null;
    for (const part of parts) if (part.vehicle >= 0) {
      if (last !== null && last !== part.vehicle) out.push({ at: part.from, was: last, is: part.vehicle });
      last = part.vehicle;
    }
    return out;
  }
  function majority(rows, mine) {
    const counts = new Map();
    for (const i of mine) if (rows.vehicle[i] >= 0) counts.set(rows.vehicle[i], (counts.get(rows.vehicle[i]) || 0) + 1);
    return [...counts].sort((a, b) => b[1] - a[1] || a[0] - b[0])[0] || [-1, 0];
  }

  function show() {
    const rows = page.shown().tracks, mine = rows.of.get(state.track);
    page.byId("track").value = mine ? String(state.track) : "";
    const life = page.byId("life"), list = page.byId("switches"), text = page.byId("track-text"), card = page.byId("track-card");
    life.replaceChildren();
    list.replaceChildren();
    charts.clear(page.byId("spectra"));
    card.hidden = !mine; // the card is shown next to the pictures while a track is chosen
    card.parentNode.classList.toggle("with-card", Boolean(mine));
    if (!mine) return;
    card.style.setProperty("--controls", `${document.querySelector(".controls").offsetHeight}px`);
    page.byId("track-title").textContent = `Track ${state.track}`;
    const first = mine[0], last = mine[mine.length - 1], parts = stretches(rows, mine), changed = switches(parts);
    const coasted = mine.filter((i) => rows.flags[i] & 1).length, [vehicle, count] = majority(rows, mine);
    text.textContent =
      `Track ${state.track} in ${page.named(state.channel)}: ${page.seconds(rows.t[first])} to ${page.seconds(rows.t[last])}, ` +
      `${frames(mine.length)}, ${coasted} of them without a detection. ` +
      (count ? `On ${called(vehicle)} in ${frames(count)}. ` : "Never on a vehicle. ") +
      `${changed.length} identity ${changed.length === 1 ? "switch" : "switches"}.`;
    life.append(line(rows, mine, parts, changed));
    for (const c of changed) list.append(page.element("button", {
      type: "button", textContent: `${page.seconds(rows.t[c.at])}: ${called(c.was)} → ${called(c.is)}`,
      onclick: () => page.setTime(rows.t[c.at]),
    }));
    spectra(vehicle);
  }

  function line(rows, mine, parts, changed) {
    const width = 1000, end = data.times_s[page.times - 1] || 1, start = data.times_s[0];
    const step = page.times > 1 ? data.times_s[1] - data.times_s[0] : 1;
    const x = (time) => ((time - start) / (end - start + step)) * width;
    const at = (i) => data.times_s[rows.t[i]];
    const picture = svg("svg", { viewBox: `0 0 ${width} 62`, class: "life", role: "img", preserveAspectRatio: "none" });
    picture.append(svg("title", {}, `Life line of track ${state.track}: ${parts.length} stretches, ${changed.length} identity switches`));
    picture.append(svg("rect", { x: 0, y: 20, width, height: 22, class: "life-none" }));
    parts.forEach((part) => picture.append(svg("rect", {
      x: x(at(part.from)), y: 20, width: Math.max(2, x(at(part.to) + step) - x(at(part.from))), height: 22,
      class: part.vehicle < 0 ? "life-lost" : "life-on",
    })));
    mine.filter((i) => rows.flags[i] & 1).forEach((i) => picture.append(svg("rect", {
      x: x(at(i)), y: 44, width: Math.max(2, x(at(i) + step) - x(at(i))), height: 6, class: "life-coast",
    })));
    changed.forEach((c) => picture.append(svg("rect", { x: x(at(c.at)) - 2, y: 10, width: 4, height: 42, class: "life-switch" })));
    picture.append(svg("rect", { id: "life-now", x: x(data.times_s[state.t]) - 1, y: 4, width: 2, height: 54, class: "life-now" }));
    picture.addEventListener("click", (e) => {
      const box = picture.getBoundingClientRect();
      page.setTime(((e.clientX - box.left) / box.width) * page.times - 0.5);
    });
    picture.dataset.step = step;
    const key = page.element("p", { className: "key" });
    for (const [name, words] of [["life-on", "on a vehicle"], ["life-lost", "on none"], ["life-coast", "no detection"], ["life-switch", "identity switch"]])
      key.append(page.element("span", { className: "keyed" }, page.element("span", { className: `swatch ${name}` }), ` ${words}`), " ");
    const both = document.createDocumentFragment();
    both.append(picture, key);
    return both;
  }
  function moveMarker() {
    const mark = document.getElementById("life-now");
    if (!mark) return;
    const step = Number(mark.parentNode.dataset.step), start = data.times_s[0];
    mark.setAttribute("x", ((data.times_s[state.t] - start) / (data.times_s[page.times - 1] - start + step)) * 1000 - 1);
  }

  function curves(packed, bands) {
    if (!packed) return [];
    const values = page.column(packed.values);
    return packed.t.map((t, k) => ({ t, values: Array.from(values.subarray(k * bands, (k + 1) * bands), (v) => v * packed.step) }));
  }

  function spectra(vehicle) {
    const box = page.byId("spectra"), { spectra: all } = page.shown();
    const mine = curves((all.tracks || {})[state.track], (all.wavelength_nm || []).length);
    const name = page.byId("class").value || paintOf(vehicle), mean = (all.classes || {})[name];
    page.byId("compare").hidden = !mine.length && !Object.keys(all.classes || {}).length;
    if (!mine.length && !mean) {
      box.append(page.element("p", { textContent: "No spectrum was served for this track." }));
      return;
    }
    const series = mine.map((s) => ({ label: page.seconds(s.t), values: s.values, colour: () => page.colour("--track"), width: 1.2 }));
    let bands;
    if (mean) {
      const edge = (sign) => mean.mean.map((v, k) => (v === null ? null : v + sign * (mean.spread[k] || 0)));
      const quiet = () => page.colour("--pan");
      series.push({ label: `mean of ${mean.count} on ${name}`, values: mean.mean, colour: quiet, width: 2.4, dash: [8, 4] });
      series.push({ label: "+1 σ", values: edge(1), colour: quiet, width: 0.5 }, { label: "−1 σ", values: edge(-1), colour: quiet, width: 0.5 });
      bands = [{ series: [series.length - 1, series.length], fill: "rgba(100,143,255,.18)" }];
    }
    charts.draw(box, {
      title: `Spectra of track ${state.track}${mean ? ` against the mean of ${name}` : ""}`, x: all.wavelength_nm,
      xlabel: "wavelength [nm]", ylabel: "radiance [W m⁻² sr⁻¹ µm⁻¹]", series, bands, height: 260,
    });
  }

  function build() {
    if (!page.byId("track-card")) return; // no tracks in this result
    page.byId("track-close").addEventListener("click", () => { page.setTrack(null); page.byId("track").focus(); });
    fillChoices();
    page.byId("track").addEventListener("change", (e) => page.setTrack(e.target.value === "" ? null : Number(e.target.value)));
    page.byId("class").addEventListener("change", show);
    page.on("track", show);
    page.on("time", moveMarker);
    page.on("channel", () => { state.track = null; fillChoices(); show(); });
    show();
  }
  function step(by) {
    const choice = page.byId("track"), n = choice ? choice.options.length : 0;
    if (n < 2) return;
    choice.selectedIndex = 1 + ((choice.selectedIndex - 1 + (choice.selectedIndex === 0 && by < 0 ? 0 : by) + n - 1) % (n - 1));
    page.setTrack(Number(choice.value));
  }
  return { build, step };
})();
