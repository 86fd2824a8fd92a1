"use strict";
// A study's page: a table that sorts, effects with intervals, parallel coordinates with ranges; curves by plots.js.
const study = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { svg, short, colourOf, mark } = plots;
  const byId = (id) => document.getElementById(id);
  const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

  function options(select, values) {
    for (const [value, label] of values) {
      const option = document.createElement("option");
      option.value = value;
      option.textContent = label;
      select.append(option);
    }
  }
  const nameOf = (key) => data.labels[key] || key;
  const column = (name) => data.columns.indexOf(name);

  function sortable() {
    const table = byId("table"), heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, k) => head.querySelector("button").addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((h) => h.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const value = (row) => {
        const text = row.cells[k].dataset.value;
        return text !== "" && Number.isFinite(Number(text)) ? Number(text) : text;
      };
      const order = (a, b) => {
        const x = value(a), y = value(b);
        if (x === "" || y === "") return (x === "") - (y === ""); // what is missing stays last
        const less = typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
        return down ? -less : less;
      };
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    }));
    for (const row of table.tBodies[0].rows) {
      const choose = (on) => highlight(on ? Number(row.dataset.row) : null);
      row.addEventListener("focusin", () => choose(true));
      row.addEventListener("focusout", () => choose(false));
      row.addEventListener("mouseenter", () => choose(true));
      row.addEventListener("mouseleave", () => choose(false));
    }
  }

  const CHANNELS = { dolp: "DoLP", all: "all elements" };

  const NARROW = 620; // in a box less wide [px] a row's label stands above its marks
  const rounded = (text) => text.replace(/-?\d+\.\d+/g, (number) => short(Number(number)));

  // a text in lines of so many characters, broken at spaces
  function wrapped(text, most) {
    const out = [];
    for (const word of text.split(" ")) {
      const last = out.length - 1;
      if (last >= 0 && `${out[last]} ${word}`.length <= most) out[last] += ` ${word}`; else out.push(word);
    }
    return out;
  }

  // Marks with intervals, one row each label and one mark a channel; entries: {row, channel, value, low, high}.
  function dots(box, entries, title, xlabel, zero) {
    const rows = [...new Set(entries.map((e) => e.row))], channels = [...new Set(entries.map((e) => e.channel))];
    const narrow = box.clientWidth < NARROW, width = narrow ? Math.max(box.clientWidth, 260) : 860, left = narrow ? 10 : 390, right = narrow ? 10 : 20;
    const said = rows.map((row) => wrapped(rounded(row), narrow ? Math.floor(width / 6.9) : 54)), tops = [];
    let height = 8; // of each row: its marks, and its label above or beside them
    said.forEach((text) => { tops.push(height); height += narrow ? 15 * text.length + 40 : Math.max(15 * text.length + 8, 34); });
    height += 50;
    const ends = entries.flatMap((e) => [e.value, e.low, e.high]).filter((v) => v !== null).concat(zero ? 0 : []);
    const low = Math.min(...ends), high = Math.max(...ends), room = 0.06 * (high - low || Math.abs(high) || 1);
    const x = (v) => left + ((v - low + room) / (high - low + 2 * room)) * (width - left - right);
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "plot", role: "img" });
    picture.append(svg("title", {}, title));
    picture.append(svg("line", { x1: left, x2: width - right, y1: height - 42, y2: height - 42, class: "axis" }));
    if (zero) picture.append(svg("line", { x1: x(0), x2: x(0), y1: 6, y2: height - 42, class: "axis" }));
    rows.forEach((row, k) => {
      const text = said[k], y = narrow ? tops[k] + 15 * text.length + 19 : tops[k] + Math.max(7.5 * text.length + 4, 17);
      text.forEach((line, n) => picture.append(svg("text", narrow ? { x: 2, y: tops[k] + 12 + 15 * n }
        : { x: left - 12, y: y + 4 + 15 * (n - (text.length - 1) / 2), "text-anchor": "end" }, line)));
      channels.forEach((m, n) => {
        const e = entries.find((one) => one.channel === m && one.row === row);
        if (!e || e.value === null) return;
        const at = y + 10 * (n - (channels.length - 1) / 2), colour = colourOf(m);
        if (e.low !== null) picture.append(svg("line", { x1: x(e.low), x2: x(e.high), y1: at, y2: at, style: `stroke:${colour}`, class: "interval" }));
        const one = mark(m, x(e.value), at, 4);
        one.setAttribute("style", `fill:${colour}`);
        one.append(svg("title", {}, `${CHANNELS[m] || m}, ${row}: ${short(e.value)}${e.low === null ? "" : ` (${short(e.low)} to ${short(e.high)})`}`));
        picture.append(one);
      });
    });
    const marks = zero ? [low, 0, high] : [low, high];
    marks.filter((v, k, all) => all.indexOf(v) === k && (!zero || v === 0 || Math.abs(x(v) - x(0)) > 46)).forEach((v) =>
      picture.append(svg("text", { x: x(v), y: height - 24, "text-anchor": "middle" }, short(v))));
    picture.append(svg("text", { x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, xlabel));
    box.replaceChildren(picture, plots.key(channels.map((m) => ({ label: CHANNELS[m] || m, channel: m, interval: true }))));
  }

  // A chart of the chosen score; absent with its section where there is nothing to draw.
  function chosen(name, all, rowOf, valueOf, words, zero) {
    const select = byId(`${name}-response`), box = byId(`${name}-chart`);
    if (!select) return;
    options(select, [...new Set(all.map((e) => e.response))].map((r) => [r, nameOf(r)]));
    const draw = () => {
      const mine = all.filter((e) => e.response === select.value);
      dots(box, mine.map((e) => ({ ...e, row: rowOf(e), value: valueOf(e) })), `${words} ${nameOf(select.value)}`, `${words} ${nameOf(select.value)}`.trim(), zero);
    };
    select.addEventListener("change", draw);
    draw();
    let width = box.clientWidth;
    new ResizeObserver(() => {
      if (box.clientWidth !== width && Math.min(box.clientWidth, width) < NARROW) draw();
      width = box.clientWidth;
    }).observe(box);
  }

  const ranges = {};
  let lines = [];
  function scaleOf(name, rows, top, bottom) {
    const values = rows.map((r) => r[column(name)]).filter((v) => v !== null);
    if (values.every((v) => typeof v === "number")) {
      const low = Math.min(...values), high = Math.max(...values);
      const y = (v) => bottom - ((v - low) / (high - low || 1)) * (bottom - top);
      return { y, marks: low === high ? [low] : [low, 0.5 * (low + high), high] };
    }
    const levels = [...new Set(values.map(String))];
    return { y: (v) => bottom - ((levels.indexOf(String(v)) + 0.5) / levels.length) * (bottom - top), marks: levels };
  }
  function shade(fraction) {
    const at = Math.max(0, Math.min(1, fraction)) * (VIRIDIS.length - 1), k = Math.min(Math.floor(at), VIRIDIS.length - 2);
    return `rgb(${VIRIDIS[k].map((v, c) => Math.round(v + (at - k) * (VIRIDIS[k + 1][c] - v))).join(",")})`;
  }

  function parallel() {
    const channels = [...new Set(data.rows.map((r) => r[column("channel")]))];
    options(byId("parallel-channel"), [["", "every channel"], ...channels.map((m) => [m, CHANNELS[m] || m])]);
    options(byId("parallel-colour"), data.responses.map((r) => [r, nameOf(r)]));
    ["parallel-channel", "parallel-colour"].forEach((id) => byId(id).addEventListener("change", draw));
    byId("parallel-clear").addEventListener("click", () => { Object.keys(ranges).forEach((k) => delete ranges[k]); draw(); });
    draw();

    function draw() {
      const box = byId("parallel-chart"), channel = byId("parallel-channel").value, by = byId("parallel-colour").value;
      const names = [...data.varied, ...data.responses];
      const rows = data.rows.map((r, k) => ({ r, k })).filter(({ r }) => r[column("status")] === "finished" && (!channel || r[column("channel")] === channel));
      if (!rows.length || names.length < 2) { box.textContent = "There is nothing to compare yet."; keep(); return; }
      const gap = 150, side = 92, width = Math.max(640, gap * names.length), height = 366, top = 82, bottom = height - 28;
      const x = (k) => side + (k * (width - 2 * side)) / (names.length - 1);
      const scales = names.map((n) => scaleOf(n, rows.map((o) => o.r), top, bottom));
      const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, class: "plot parallel", role: "img" });
      picture.append(svg("title", {}, `${rows.length} rows over ${names.map(nameOf).join(", ")}`));
      const values = rows.map(({ r }) => r[column(by)]).filter((v) => v !== null), low = Math.min(...values), high = Math.max(...values);
      lines = rows.map(({ r, k }) => {
        const points = names.map((n, i) => (r[column(n)] === null ? null : `${x(i)},${scales[i].y(r[column(n)])}`)).filter(Boolean);
        const line = svg("polyline", { points: points.join(" "), "data-row": k, style: `stroke:${shade((r[column(by)] - low) / (high - low || 1))}` });
        line.append(svg("title", {}, names.map((n) => `${nameOf(n)} ${short(r[column(n)])}`).join(", ")));
        picture.append(line);
        return { line, r, k, ys: names.map((n, i) => (r[column(n)] === null ? null : scales[i].y(r[column(n)]))) };
      });
      names.forEach((name, i) => {
        picture.append(svg("line", { x1: x(i), x2: x(i), y1: top, y2: bottom, class: "axis" }));
        const outer = i === 0 ? { x: x(i) - side + 4 } : i === names.length - 1 ? { x: x(i) + side - 4, "text-anchor": "end" } : null;
        const said = nameOf(name), head = said.includes(" ") ? wrapped(said, 22) : said.split(/(?<=\.)/), inward = i < names.length - 1 ? { x: x(i) + 6 } : { x: x(i) - 6, "text-anchor": "end" };
        head.forEach((line, n) => picture.append(svg("text", { ...(outer || { x: x(i), "text-anchor": "middle" }), y: top - 14 - 14 * (head.length - 1 - n) }, line)));
        scales[i].marks.forEach((v) => wrapped(short(v), 20).forEach((line, n) =>
          picture.append(svg("text", { ...inward, y: scales[i].y(v) + 4 + 13 * n, class: "mark" }, line))));
        brush(picture, name, i, x(i), top, bottom);
      });
      box.replaceChildren(picture);
      keep();
    }

    function brush(picture, name, i, at, top, bottom) {
      const shown = svg("rect", { x: at - 8, width: 16, class: "brush", y: 0, height: 0 });
      const hit = svg("rect", { x: at - 14, y: top - 6, width: 28, height: bottom - top + 12, class: "hit" });
      picture.append(shown, hit);
      const place = () => {
        const range = ranges[name];
        shown.setAttribute("y", range ? range[0] : 0);
        shown.setAttribute("height", range ? range[1] - range[0] : 0);
      };
      const y = (e) => {
        const point = new DOMPoint(e.clientX, e.clientY).matrixTransform(picture.getScreenCTM().inverse());
        return Math.max(top - 4, Math.min(bottom + 4, point.y));
      };
      let from = null;
      hit.addEventListener("pointerdown", (e) => { from = y(e); hit.setPointerCapture(e.pointerId); delete ranges[name]; place(); keep(); });
      hit.addEventListener("pointermove", (e) => {
        if (from === null) return;
        const to = y(e);
        if (Math.abs(to - from) > 3) { ranges[name] = [Math.min(from, to), Math.max(from, to)]; ranges[name].index = i; place(); keep(); }
      });
      hit.addEventListener("pointerup", () => { from = null; });
      place();
    }
  }

  function keep() {
    const chosen = new Set();
    for (const one of lines) {
      const inside = Object.values(ranges).every((range) => one.ys[range.index] !== null && one.ys[range.index] >= range[0] && one.ys[range.index] <= range[1]);
      one.line.classList.toggle("out", !inside);
      if (inside) chosen.add(one.k);
    }
    const any = Object.keys(ranges).length > 0;
    for (const row of byId("table").tBodies[0].rows) row.hidden = any && !chosen.has(Number(row.dataset.row));
    byId("parallel-count").textContent = `${chosen.size} of ${lines.length} rows`;
  }
  function highlight(k) {
    for (const one of lines) one.line.classList.toggle("chosen", one.k === k);
    const chosen = lines.find((one) => one.k === k);
    if (chosen) chosen.line.parentNode.insertBefore(chosen.line, chosen.line.parentNode.querySelector(".axis"));
  }

  theme.start(() => {});
  chosen("effects", data.effects, (e) => `${e.axis}: ${e.level}`, (e) => e.effect, "change of", true);
  chosen("points", data.points, (e) => e.point, (e) => e.score, "", false);
  if (byId("parallel")) parallel();
  if (byId("front-chart")) plots.draw(byId("front-chart"), data.front);
  if (byId("curves-charts")) plots.draw(byId("curves-charts"), data.plots);
  sortable();
  document.documentElement.dataset.ready = "yes";
  return { data };
})();
