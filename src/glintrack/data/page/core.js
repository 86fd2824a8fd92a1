"use strict";
// Data of the page, small helpers, and the state all parts share. Text from the result is only ever set as text.
const page = (() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const data = read("data");
  const KINDS = { u1: Uint8Array, u2: Uint16Array, i2: Int16Array, i4: Int32Array, f4: Float32Array };

  function column(packed) {
    const raw = atob(packed.data), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new KINDS[packed.kind](bytes.buffer);
  }

  // Rows in order of time, with where each time's rows begin and which rows belong to each id.
  function rows(packed, times) {
    const out = { count: packed ? packed.count : 0, begin: new Int32Array(times + 1), of: new Map() };
    if (!out.count) return out;
    for (const [name, value] of Object.entries(packed))
      if (value && value.kind) out[name] = column(value);
    out.t = new Uint32Array(out.count);
    for (let t = 0, i = 0; t < times; t++) {
      out.begin[t + 1] = out.begin[t] + out.per[t];
      out.t.fill(t, i, out.begin[t + 1]);
      i = out.begin[t + 1];
    }
    for (let i = 0; i < out.count; i++) {
      const mine = out.of.get(out.id[i]);
      if (mine) mine.push(i); else out.of.set(out.id[i], [i]);
    }
    return out;
  }

  const times = data.times_s.length;
  const channels = {};
  for (const [name, part] of Object.entries(data.channels))
    channels[name] = { ...part, tracks: rows(part.tracks, times), queries: rows(part.queries, times) };

  const state = {
    t: 0, channel: data.speaks || Object.keys(channels)[0] || "", track: null, playing: false,
    layers: { tracks: true, truth: true, tails: false, ids: false, predictions: false, queries: false },
    kinds: {}, zoom: 1, cx: 0, cy: 0,
  };
  const listeners = { time: [], look: [], track: [], channel: [], theme: [] };
  const on = (what, f) => listeners[what].push(f);
  const notify = (what) => listeners[what].forEach((f) => f());

  function setTime(t) {
    t = Math.max(0, Math.min(times - 1, Math.round(t)));
    if (t !== state.t && times) { state.t = t; notify("time"); }
  }
  function setTrack(id) { state.track = id; notify("track"); notify("look"); }

  function element(tag, properties = {}, ...children) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(properties))
      if (name in node && name !== "list") node[name] = value; else node.setAttribute(name, value);
    node.append(...children);
    return node;
  }
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const byId = (id) => document.getElementById(id);
  const seconds = (t) => (times ? data.times_s[t].toFixed(2) + " s" : "–");

  return {
    data, read, column, state, times, channels, truth: rows(data.truth, times), on, notify, setTime, setTrack,
    element, colour, byId, seconds,
    named: (channel) => ({ dolp: "DoLP", all: "all elements" })[channel] || channel,
    shown: () => channels[state.channel] || { tracks: rows(null, times), queries: rows(null, times), spectra: {} },
  };
})();
