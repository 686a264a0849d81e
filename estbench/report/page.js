"use strict";
(() => {
  const page = JSON.parse(document.getElementById("page-data").textContent);
  const plots = [...document.querySelectorAll(".plot")];
  const state = {
    entries: new Set(page.shown.entries),
    coordinates: new Set(page.shown.coordinates),
    run: page.shown.run,
    range: null,
  };
  const $ = (id) => document.getElementById(id);
  const decoded = new Map();

  // Numbers travel as {dtype, bdata, shape}: little-endian, base64, row after row.
  function rows(packed) {
    if (!decoded.has(packed)) {
      const bytes = Uint8Array.from(atob(packed.bdata), (c) => c.charCodeAt(0));
      const values = new Float32Array(bytes.buffer);
      const width = packed.shape[1];
      const out = [];
      for (let r = 0; r < packed.shape[0]; r++) out.push(values.subarray(r * width, (r + 1) * width));
      decoded.set(packed, out);
    }
    return decoded.get(packed);
  }

  function style() {
    const css = getComputedStyle(document.documentElement);
    return { ink: css.getPropertyValue("--ink").trim(), line: css.getPropertyValue("--line").trim(),
      panel: css.getPropertyValue("--panel").trim(), page: css.getPropertyValue("--page").trim() };
  }

  // The traces of a drawing for what is chosen, with the chosen run's data in them.
  function chosen(drawing) {
    const bands = new Set(), events = new Set();
    const out = [];
    for (const trace of drawing.traces) {
      const meta = trace.meta || {};
      if (meta.entry && !meta.always && !state.entries.has(meta.entry)) continue;
      if (meta.band) {
        const id = meta.band + meta.side;
        if (bands.has(id)) continue;
        bands.add(id);
      }
      const run = (page.runs[state.run] || {})[meta.entry];
      if (meta.event) {
        // Entries share the truth, and so the events.
        if (!run || !run.events[meta.event] || events.has(meta.event)) continue;
        events.add(meta.event);
        const x = rows(run.events[meta.event])[0];
        out.push({ ...trace, x, y: new Float32Array(x.length) });
        continue;
      }
      if (!meta.bind) { out.push(trace); continue; }
      if (!run) continue;
      const y = rows(run[meta.bind.field])[meta.bind.row];
      const scale = meta.bind.scale;
      out.push({ ...trace, x: rows(run.time)[0], y: scale === 1 ? y : y.map((v) => v * scale) });
    }
    return out;
  }

  function values(array) {
    if (array && array.bdata) {
      const bytes = Uint8Array.from(atob(array.bdata), (c) => c.charCodeAt(0));
      const kind = { f8: Float64Array, f4: Float32Array, i1: Int8Array, u1: Uint8Array,
        i2: Int16Array, u2: Uint16Array, i4: Int32Array, u4: Uint32Array }[array.dtype];
      return new kind(bytes.buffer);
    }
    return array || [];
  }

  // The y range of what is visible between two times, so that a zoom in time fills the height.
  // Of a whole run the first instants, where the prior is forgotten, do not set the range.
  // On a logarithmic axis the least hundredth, where a curve crosses zero, does not set it either.
  function fit(traces, range, log, trim) {
    const seen = [];
    let low = Infinity, high = -Infinity;
    if (trim) range = [range[0] + 0.06 * (range[1] - range[0]), range[1]];
    for (const trace of traces) {
      if (trace.yaxis) continue; // marks of events, on an axis of their own
      const x = values(trace.x), y = values(trace.y);
      for (let i = 0; i < x.length; i++) {
        const v = y[i];
        if (x[i] < range[0] || x[i] > range[1] || !isFinite(v) || (log && v <= 0)) continue;
        if (log) seen.push(v);
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    if (!isFinite(low)) return null;
    if (log) {
      low = Math.log10(seen.sort((a, b) => a - b)[Math.floor(0.01 * seen.length)]);
      high = Math.log10(high);
    }
    const pad = 0.06 * (high - low) || 0.5;
    return [low - pad, high + pad];
  }

  function layout(drawing, traces) {
    const look = style();
    const narrow = window.innerWidth < 600;
    const axis = { gridcolor: look.line, zerolinecolor: look.line, linecolor: look.line,
      tickcolor: look.line, automargin: true };
    const given = drawing.layout;
    const out = { ...given, height: drawing.height, autosize: true, paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)", font: { color: look.ink, size: narrow ? 11 : 12 },
      margin: { l: 48, r: 12, t: 10, b: 40 }, hovermode: drawing.time ? "x unified" : "closest",
      hoverlabel: { bgcolor: look.panel, bordercolor: look.line, font: { color: look.ink } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: look.line, activecolor: look.ink },
      dragmode: window.matchMedia("(pointer: coarse)").matches ? false : "zoom",
      xaxis: { ...axis, ...given.xaxis }, yaxis: { ...axis, ...given.yaxis } };
    if (drawing.time) {
      out.xaxis.range = state.range || page.span;
      out.yaxis.fixedrange = true;
      const log = out.yaxis.type === "log";
      const range = (state.range || drawing.trim) && fit(traces, state.range || page.span, log, !state.range);
      if (range) { out.yaxis.range = range; out.yaxis.autorange = false; }
    }
    if (out.yaxis.type === "log") {
      const range = out.yaxis.range || fit(traces, [-Infinity, Infinity], true, false) || [0, 1];
      out.yaxis.dtick = range[1] - range[0] < 2 ? "D2" : Math.ceil((range[1] - range[0]) / 6);
    }
    return out;
  }

  let syncing = false;

  function draw(div) {
    const drawing = page.drawings[div.id];
    const traces = chosen(drawing);
    const fresh = !div.dataset.drawn;
    const config = { responsive: true, displaylogo: false, displayModeBar: drawing.height > 240,
      modeBarButtons: [["toImage", "resetScale2d"]] };
    Plotly.react(div, traces, layout(drawing, traces), config);
    div.dataset.drawn = traces.length;
    if (fresh && drawing.time) {
      div.on("plotly_relayout", (change) => {
        if (syncing) return;
        if (change["xaxis.autorange"]) setRange(null);
        else if ("xaxis.range[0]" in change)
          setRange([change["xaxis.range[0]"], change["xaxis.range[1]"]]);
        else if (change["xaxis.range"]) setRange([...change["xaxis.range"]]);
      });
      div.on("plotly_click", (event) => seek(event.points[0].x));
    }
  }

  let generation = 0;
  async function redraw(only = () => true) {
    const mine = ++generation;
    document.body.dataset.state = "drawing";
    for (const div of plots) {
      const drawing = page.drawings[div.id];
      const hide = drawing.coordinate !== null && !state.coordinates.has(drawing.coordinate);
      div.closest("figure").hidden = hide;
      if (hide || !only(drawing)) continue;
      syncing = true;
      try { draw(div); } finally { syncing = false; }
      await new Promise((next) => setTimeout(next));
      if (mine !== generation) return;
    }
    document.body.dataset.state = "ready";
  }

  function setRange(range) {
    state.range = range;
    $("from").value = (range || page.span)[0].toPrecision(4) / 1;
    $("to").value = (range || page.span)[1].toPrecision(4) / 1;
    redraw((drawing) => drawing.time);
  }

  // The browser's own controls would lie on the chart under the picture.
  for (const button of document.querySelectorAll(".play")) {
    const video = button.closest("figure").querySelector("video");
    const toggle = () => { if (video.paused) video.play(); else video.pause(); };
    const show = () => {
      button.textContent = video.paused ? "▶" : "❚❚";
      button.setAttribute("aria-label", (video.paused ? "play: " : "pause: ") + video.ariaLabel);
    };
    for (const target of [button, video]) target.addEventListener("click", toggle);
    for (const event of ["play", "pause"]) video.addEventListener(event, show);
  }

  // A click on a time shows that time in the videos.
  function seek(time) {
    for (const video of document.querySelectorAll("video")) {
      video.pause();
      video.currentTime = Math.max(0, time / Number(video.dataset.speed));
    }
  }

  function press(button, on) { button.setAttribute("aria-pressed", on ? "true" : "false"); }

  function chips(selector, set, of, after) {
    const buttons = [...document.querySelectorAll(selector)];
    const show = () => buttons.forEach((b) => press(b, set.has(of(b))));
    for (const button of buttons) {
      button.addEventListener("click", (event) => {
        const id = of(button);
        if (event.shiftKey || event.altKey) { set.clear(); set.add(id); }
        else if (set.has(id)) set.delete(id);
        else set.add(id);
        show();
        after();
      });
    }
    show();
    return (ids) => { set.clear(); ids.forEach((id) => set.add(id)); show(); after(); };
  }

  const setEntries = chips("[data-entry]", state.entries, (b) => b.dataset.entry, () => redraw());
  const setCoordinates = chips("[data-coordinate]", state.coordinates,
    (b) => Number(b.dataset.coordinate), () => redraw());
  for (const button of document.querySelectorAll("[data-all]")) {
    button.addEventListener("click", () => {
      const all = button.dataset.all === "1";
      if (button.dataset.of === "entries") setEntries(all ? page.entries : []);
      else setCoordinates(all ? page.coordinates.map((_, i) => i) : []);
    });
  }

  const select = $("run");
  if (select) {
    const pick = (by) => {
      const index = Math.min(select.options.length - 1, Math.max(0, select.selectedIndex + by));
      select.selectedIndex = index;
      select.dispatchEvent(new Event("change"));
    };
    select.value = state.run;
    select.addEventListener("change", () => {
      state.run = select.value;
      document.querySelectorAll(".run-number").forEach((e) => { e.textContent = state.run; });
      redraw((drawing) => drawing.bound);
    });
    $("previous").addEventListener("click", () => pick(-1));
    $("next").addEventListener("click", () => pick(1));
  }
  for (const id of ["from", "to"]) $(id).addEventListener("change", () => {
    const low = Number($("from").value), high = Number($("to").value);
    if (high > low) setRange([low, high]);
  });
  $("whole").addEventListener("click", () => setRange(null));

  const baseline = $("baseline");
  if (baseline) {
    const show = () => document.querySelectorAll("[data-baseline]").forEach((table) => {
      table.hidden = table.dataset.baseline !== baseline.value;
    });
    baseline.addEventListener("change", show);
    show();
  }

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let theme = null;
  function applyTheme() {
    document.documentElement.dataset.theme = theme || (dark.matches ? "dark" : "light");
    $("theme").textContent = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  }
  dark.addEventListener("change", () => { applyTheme(); redraw(); });
  $("theme").addEventListener("click", () => {
    theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    applyTheme();
    redraw();
  });
  applyTheme();
  setRange(null);
  redraw();
})();
