"use strict";
// Predicted scores of a chosen design, with intervals of 90 %: the response surfaces of a study (study/analysis.py)
// or the Gaussian processes of an optimization (study/optimize/surrogate.py). No prediction outside the ranges.
const predict = (() => {
  const data = JSON.parse(document.getElementById("data").textContent).predict;
  const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);

  function surface(p, x) {
    const terms = [1, ...x];
    if (p.quadratic) x.forEach((a, i) => x.slice(i).forEach((b) => terms.push(a * b)));
    const middle = dot(terms, p.coefficients);
    const reach = p.reach * Math.sqrt(1 + p.whitening.reduce((sum, row) => sum + dot(row, terms) ** 2, 0));
    return [middle, middle - reach, middle + reach];
  }

  function process(p, places) {
    const at = [...places, 0]; // at the full duration
    const cross = p.inputs.map((row) => {
      const r = Math.sqrt(5) * Math.hypot(...row.map((value, k) => (value - at[k]) / p.lengths[k]));
      return p.mean_variance + p.signal_variance * (1 + r + (r * r) / 3) * Math.exp(-r);
    });
    const middle = p.mean + dot(cross, p.weights);
    const variance = p.mean_variance + p.signal_variance - dot(cross, p.inverse.map((row) => dot(row, cross)));
    const reach = data.deviate * Math.sqrt(Math.max(variance, 0));
    return [middle, middle - reach, middle + reach].map(p.logarithmic ? Math.expm1 : (value) => value);
  }

  // place of a level in its range: 0 to 1, or a column for each word
  function places(axis, level) {
    if (axis.labels.length && !axis.ordered) return axis.labels.map((one) => (one === level ? data.word : 0));
    if (axis.labels.length) return [[...axis.labels].sort((a, b) => a - b).indexOf(level) / Math.max(axis.labels.length - 1, 1)];
    const [low, high, value] = [axis.low, axis.high, level].map((one) => (axis.log ? Math.log(one) : one));
    return [(value - low) / (high - low)];
  }

  const isInside = (axis, level) => (axis.labels.length ? axis.labels.includes(level) : level >= axis.low && level <= axis.high);

  // [middle, low, high] of each predictor; null outside the ranges
  function at(levels) {
    if (!data.axes.every((axis, k) => isInside(axis, levels[k]))) return null;
    const all = data.axes.flatMap((axis, k) => places(axis, levels[k]));
    return data.predictors.map((p) => (p.inputs ? process(p, all) : surface(p, all.map((value) => 2 * value - 1))));
  }

  function control(axis, changed) {
    const label = document.createElement("label"), shown = document.createElement("input");
    label.append(`${axis.name} `);
    if (axis.labels.length) {
      const select = document.createElement("select");
      axis.labels.forEach((one) => select.append(new Option(String(one))));
      select.selectedIndex = axis.labels.indexOf(axis.value);
      select.addEventListener("input", changed);
      label.append(select);
      return { label, level: () => axis.labels[select.selectedIndex] };
    }
    const slider = document.createElement("input"), round = (v) => (axis.integer ? Math.round(v) : Number(v.toPrecision(4)));
    const value = (place) => (axis.log ? axis.low * (axis.high / axis.low) ** place : axis.low + place * (axis.high - axis.low));
    Object.assign(slider, { type: "range", min: 0, max: 1, step: 0.001, value: places(axis, axis.value)[0] });
    Object.assign(shown, { type: "number", step: "any", value: round(axis.value) });
    slider.setAttribute("aria-label", `${axis.name}, slider`);
    slider.addEventListener("input", () => { shown.value = Math.min(Math.max(round(value(Number(slider.value))), axis.low), axis.high); changed(); });
    shown.addEventListener("input", () => { if (isInside(axis, shown.valueAsNumber)) slider.value = places(axis, shown.valueAsNumber)[0]; changed(); });
    label.append(slider, shown, ` ${plots.short(axis.low)} to ${plots.short(axis.high)}`);
    return { label, level: () => shown.valueAsNumber };
  }

  function start(box, body, note) {
    const show = () => {
      const found = at(controls.map((one) => one.level()));
      note.textContent = found ? "" : "Outside the ranges that were simulated: no prediction.";
      data.predictors.forEach((p, k) => {
        const cells = found ? [plots.short(found[k][0]), `${plots.short(found[k][1])} to ${plots.short(found[k][2])}`] : ["–", "–"];
        cells.forEach((text, n) => { body.rows[k].cells[n + 1].textContent = text; });
      });
    };
    for (const p of data.predictors) {
      const row = body.insertRow(), head = document.createElement("th");
      head.scope = "row";
      head.textContent = p.label;
      row.append(head, document.createElement("td"), document.createElement("td"));
    }
    const controls = data.axes.map((axis) => control(axis, show));
    box.append(...controls.map((one) => one.label));
    show();
  }

  if (data) start(document.getElementById("predict-axes"), document.getElementById("predict-scores"), document.getElementById("predict-note"));
  return { at };
})();
