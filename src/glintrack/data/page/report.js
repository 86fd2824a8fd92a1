"use strict";
// Controls and keys; then everything is built.
(() => {
  const { state, byId, element } = page;

  function boxes(parent, names, chosen, changed) {
    for (const [name, label] of names) {
      const box = element("input", { type: "checkbox", checked: chosen[name] !== false, id: `${parent}-${name}` });
      box.addEventListener("change", () => { chosen[name] = box.checked; changed(); });
      byId(parent).append(element("label", {}, box, ` ${label}`));
    }
  }

  let timer = null;
  function play(on) {
    state.playing = on && page.times > 1;
    byId("play").textContent = state.playing ? "Pause" : "Play";
    byId("play").setAttribute("aria-pressed", String(state.playing));
    clearTimeout(timer);
    if (state.playing && state.t === page.times - 1) page.setTime(0);
    const next = () => {
      if (!state.playing) return;
      if (state.t >= page.times - 1) { play(false); return; }
      page.setTime(state.t + 1);
      wait();
    };
    const wait = () => {
      const gap = page.data.times_s[Math.min(state.t + 1, page.times - 1)] - page.data.times_s[state.t];
      timer = setTimeout(next, Math.max(40, 1000 * gap));
    };
    if (state.playing) wait();
  }

  function keys(event) {
    const tag = event.target.tagName, inside = tag === "SELECT" || tag === "SUMMARY" || (tag === "INPUT" && event.target.type !== "checkbox");
    if (event.ctrlKey || event.metaKey || event.altKey || inside) return;
    if (tag === "BUTTON" && (event.key === " " || event.key === "Enter")) return;
    if (tag === "INPUT" && event.key === " ") return;
    const names = Object.keys(state.layers);
    const does = {
      ArrowRight: () => page.setTime(state.t + 1), ArrowLeft: () => page.setTime(state.t - 1),
      Home: () => page.setTime(0), End: () => page.setTime(page.times - 1), " ": () => play(!state.playing),
      "+": () => film.zoom(1.5), "=": () => film.zoom(1.5), "-": () => film.zoom(1 / 1.5), 0: film.whole,
      n: () => tracks.step(1), p: () => tracks.step(-1), Escape: () => page.setTrack(null),
    };
    if (event.key >= "1" && event.key <= String(names.length)) does[event.key] = () => byId(`layers-${names[event.key - 1]}`).click();
    if (does[event.key]) { event.preventDefault(); does[event.key](); }
  }

  function build() {
    const slider = byId("time"), choice = byId("channel");
    slider.max = String(Math.max(0, page.times - 1));
    slider.disabled = byId("play").disabled = page.times < 2;
    slider.addEventListener("input", () => page.setTime(Number(slider.value)));
    page.on("time", () => { slider.value = String(state.t); slider.setAttribute("aria-valuetext", page.seconds(state.t)); });
    slider.setAttribute("aria-valuetext", page.seconds(0));
    for (const name of Object.keys(page.channels)) choice.append(element("option", { value: name, textContent: page.named(name) }));
    choice.value = state.channel;
    choice.addEventListener("change", () => { state.channel = choice.value; page.notify("channel"); });
    byId("play").addEventListener("click", () => play(!state.playing));
    byId("zoom-in").addEventListener("click", () => film.zoom(1.5));
    byId("zoom-out").addEventListener("click", () => film.zoom(1 / 1.5));
    byId("zoom-all").addEventListener("click", film.whole);
    boxes("layers", [["tracks", "tracks"], ["truth", "missed vehicles"], ["tails", "tails"], ["ids", "ids"], ["predictions", "predictions"], ["queries", "spectra"]],
      state.layers, () => page.notify("look"));
    boxes("kinds", film.kinds.map((k) => [k, film.names[k][0]]), state.kinds, () => page.notify("look"));
    document.addEventListener("keydown", keys);
    theme.start(() => page.notify("theme"));
    film.build();
    charts.start();
    charts.scores();
    charts.quality();
    tracks.build();
    if (page.times) page.setTime(Math.floor(0.75 * (page.times - 1)));
    document.documentElement.dataset.ready = "yes";
  }
  build();
})();
