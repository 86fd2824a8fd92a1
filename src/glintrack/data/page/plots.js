"use strict";
// Points and lines over two axes, as SVG: what the pages of a run and of a study both draw.
const plots = (() => {
  const SVG = "http://www.w3.org/2000/svg";
  const DASHES = { pan: "", dolp: "7 4", all: "2 3" };
  const MARKS = { pan: "circle", dolp: "square", all: "triangle" };

  function svg(tag, attributes, text) {
    const node = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    return node;
  }
  const short = (v) => (typeof v === "number" ? String(Number(v.toPrecision(3))) : String(v));
  const colourOf = (channel) => `var(--${channel in MARKS ? channel : "text"})`;

  function mark(channel, x, y, r) {
    const shape = MARKS[channel] || "square";
    if (shape === "circle") return svg("circle", { cx: x, cy: y, r });
    if (shape === "square") return svg("rect", { x: x - r, y: y - r, width: 2 * r, height: 2 * r });
    const corners = shape === "triangle" ? [[0, -1.3], [1.2, 0.9], [-1.2, 0.9]] : [[0, -1.4], [1.4, 0], [0, 1.4], [-1.4, 0]];
    return svg("polygon", { points: corners.map(([a, b]) => `${x + a * r},${y + b * r}`).join(" ") });
  }

  // round numbers that an axis is marked with, four to six of them
  function ticks(low, high) {
    const raw = (high - low) / 5, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw);
    const out = [];
    for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-9 * step ? 0 : v);
    return out;
  }
  function limits(values) {
    const a = Math.min(...values), b = Math.max(...values), room = 0.05 * (b - a || Math.abs(a) || 1);
    return [a >= 0 && a - room < 0 ? 0 : a - room, b + room];
  }

  // list: [{title, xlabel, ylabel, fromZero, numbered, lines: [{label, channel, points, joined, own}]}]; a point is [x, y], [x, y, words] or [x, y, words, label]
  function draw(box, list) {
    for (const plot of list) {
      const points = plot.lines.flatMap((l) => [...l.points, ...(l.own ? [l.own] : [])]);
      if (!points.length) continue;
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      caption.textContent = plot.title;
      figure.append(caption, picture(plot, points));
      if (plot.lines.length > 1) figure.append(key(plot.lines));
      if (plot.numbered && plot.numbered.length) figure.append(ordered(plot.numbered));
      box.append(figure);
    }
    if (!box.children.length) box.textContent = "There is nothing to draw yet.";
  }

  function picture(plot, points) {
    const width = 460, height = 300, bottom = 250, top = 14, right = 16;
    const zero = plot.fromZero ? [0] : [];
    const [x0, x1] = limits([...zero, ...points.map((p) => p[0])]), [y0, y1] = limits([...zero, ...points.map((p) => p[1])]);
    const longest = Math.max(...ticks(y0, y1).map((v) => short(v).length)), left = Math.max(58, 32 + 6.6 * longest); // right of the label
    const x = (v) => left + ((v - x0) / (x1 - x0)) * (width - left - right), y = (v) => bottom - ((v - y0) / (y1 - y0)) * (bottom - top);
    const out = svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "plot", role: "img" });
    out.append(svg("title", {}, `${plot.title}; ${plot.ylabel} against ${plot.xlabel}, ${points.length} points`));
    for (const v of ticks(x0, x1)) {
      out.append(svg("line", { x1: x(v), x2: x(v), y1: top, y2: bottom, class: "grid" }));
      out.append(svg("text", { x: x(v), y: bottom + 18, "text-anchor": "middle" }, short(v)));
    }
    for (const v of ticks(y0, y1)) {
      out.append(svg("line", { x1: left, x2: width - right, y1: y(v), y2: y(v), class: "grid" }));
      out.append(svg("text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, short(v)));
    }
    out.append(svg("path", { d: `M${left},${top}V${bottom}H${width - right}`, class: "axis" }));
    out.append(svg("text", { x: (left + width - right) / 2, y: height - 12, "text-anchor": "middle" }, plot.xlabel));
    out.append(svg("text", { x: 14, y: (top + bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 14 ${(top + bottom) / 2})` }, plot.ylabel));
    for (const line of plot.lines) series(out, line, x, y);
    return out;
  }

  function ordered(texts) {
    const out = document.createElement("ol");
    texts.forEach((text) => out.append(Object.assign(document.createElement("li"), { textContent: text })));
    return out;
  }

  // marks with the line that joins them, as drawn: solid, dashed or dotted
  function key(lines) {
    const out = document.createElement("p");
    out.className = "key";
    for (const { label, channel, joined, interval } of lines) {
      const box = svg("svg", { viewBox: "0 0 34 14", width: 34, height: 14, "aria-hidden": "true" }), one = mark(channel, 17, 7, 4.5);
      const dash = interval ? "" : DASHES[channel] || "";
      if (interval || (joined && joined.length > 1))
        box.append(svg("line", { x1: 0, x2: 34, y1: 7, y2: 7, "stroke-dasharray": dash, style: `stroke:${colourOf(channel)};stroke-width:2` }));
      one.setAttribute("style", `fill:${colourOf(channel)}`);
      box.append(one);
      const entry = document.createElement("span");
      entry.className = "keyed";
      entry.append(box, ` ${label}`);
      out.append(entry);
    }
    return out;
  }

  function series(out, line, x, y) {
    const style = (what) => `${what}:${colourOf(line.channel)}`;
    if (line.joined.length > 1) out.append(svg("polyline", {
      points: line.joined.map((p) => `${x(p[0])},${y(p[1])}`).join(" "), "stroke-dasharray": DASHES[line.channel] || "", style: style("stroke"), class: "joined",
    }));
    const place = (p, r, shown, words) => {
      const one = mark(line.channel, x(p[0]), y(p[1]), r);
      one.setAttribute("style", shown);
      one.append(svg("title", {}, `${line.label}${words ? `, ${words}` : ""}: ${short(p[0])}, ${short(p[1])}`));
      out.append(one);
    };
    for (const p of line.points) place(p, 3.5, style("fill"), p[2]);
    for (const p of line.joined) if (p[3]) out.append(svg("text", { x: x(p[0]), y: y(p[1]) - 7, "text-anchor": "middle", class: "mark" }, p[3]));
    if (line.own) place(line.own, 8, `fill:none;stroke-width:2.5;${style("stroke")}`, "this run");
  }

  return { svg, short, colourOf, mark, key, draw };
})();
