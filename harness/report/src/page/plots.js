// Draws the plots of the report with uPlot. The panels of a scenario show the same time.
// The data contain names and content of each panel. If the script fails, the page shows the drawings.
"use strict";
(() => {
  const DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  const WORTH = new Map([...DIGITS].map((digit, worth) => [digit, worth]));
  const HEIGHT = 250, HEIGHT_STIMULUS = 84, HEIGHT_AXIS = 44, WIDTH_AXIS = 72;
  // Colour (a variable of the style sheet), width of a line or of an area's edges, dashes, opacity.
  const PENS = {
    first: ["--first", 1.75], second: ["--second", 1.75], "deciding-trial": ["--verdict", 1.75], other: ["--other", 1.5, [6, 4]],
    resonance: ["--second", 1.5, [4, 3]], "open-loop": ["--other", 1.5, [10, 3, 2, 3]],
    limit: ["--verdict", 1.75], window: ["--verdict", 0, [], 0.07], worst: ["--verdict", 2], setpoint: ["--ink", 1.25, [2, 3]], golden: ["--golden", 1.5, [9, 3]], trial: ["--first", 0.75, [], 0.4],
    median: ["--first", 1, [1, 3]], settling: ["--settling", 1.5, [5, 3]], deadline: ["--fail", 1.5, [2, 2]], overrun: ["--fail", 1.5], band: ["--settling", 1, [], "--band"],
    tube: ["--golden", 0, [], 0.16], spread: ["--first", 0, [], 0.22], "second-spread": ["--second", 0, [], 0.22],
    saturated: ["--amber", 0, [], 0.28], lost: ["--fail", 0, [], 0.16],
  };

  // Decodes lowest value, height of a step and differences of neighbours (see encode.rs).
  function unpack([low, step, text]) {
    const values = [];
    let count = 0, rest = 0, shift = 0;
    for (const digit of text) {
      if (digit === "!") { values.push(null); continue; }
      const worth = WORTH.get(digit);
      rest |= (worth & 31) << shift;
      shift += 5;
      if (worth < 32) {
        count += rest & 1 ? -(rest >> 1) : rest >> 1;
        values.push(low + count * step);
        rest = shift = 0;
      }
    }
    return values;
  }

  function made(tag, attributes, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }

  // `#rgb` or `#rrggbb` of the style sheet, with an opacity: a number, or a variable of the style sheet that holds one.
  function colour(at, name, opacity = 1) {
    const style = getComputedStyle(at);
    let hex = style.getPropertyValue(name).trim();
    if (typeof opacity === "string") opacity = +style.getPropertyValue(opacity);
    if (hex.length === 4) hex = "#" + [...hex.slice(1)].map((digit) => digit + digit).join("");
    return hex + Math.round(opacity * 255).toString(16).padStart(2, "0");
  }

  function shown(value, span) {
    const decimals = span > 0 ? Math.min(6, Math.max(0, 3 - Math.floor(Math.log10(span)))) : 4;
    return value.toFixed(decimals).replace("-", "−");
  }

  function line_swatch(ink, width, dash) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    const stroke = `stroke="currentColor" stroke-width="${Math.max(1.5, width)}" stroke-dasharray="${(dash ?? []).join(" ")}"`;
    svg.setAttribute("class", "mark");
    svg.setAttribute("viewBox", "0 0 28 10");
    svg.setAttribute("aria-hidden", "true");
    svg.innerHTML = ink === "worst" ? '<circle cx="14" cy="5" r="4" fill="currentColor"/>' : `<path d="M0 5H28" fill="none" ${stroke}/>`;
    return svg;
  }

  class Scenario {
    constructor(section, data, key) {
      this.section = section;
      this.data = data;
      this.key = key;
      this.plots = [];
      [, this.first, this.last] = data.views[data.views.length - 1];
      [, this.from, this.to] = data.views[0];
      this.bar = this.toolbar();
      this.hosts = data.panels.map((panel, index) => this.host(panel, index));
      this.root = made("div", { class: "plots" }, made("h3", {}, "Plots"), this.bar, ...this.hosts.map((host) => host.figure));
      this.say();
    }

    toolbar() {
      const button = (text, label, act) => {
        const made_ = made("button", { type: "button", "aria-label": label, title: label }, text);
        made_.addEventListener("click", act);
        return made_;
      };
      this.time = made("span", { class: "time" });
      const views = this.data.views.map(([name, from, to]) => button(name, name, () => this.zoom(from, to)));
      return made("div", { class: "tools", role: "group", "aria-label": "Time of the plots: " + this.data.title }, ...views,
        button("+", "Zoom in", () => this.scale(0.5)), button("−", "Zoom out", () => this.scale(2)),
        button("◀", "Earlier", () => this.shift(-0.25)), button("▶", "Later", () => this.shift(0.25)), this.time);
    }

    host(panel, index) {
      const label = `${panel.title} in ${panel.unit} against time. Arrow keys move, + and − zoom, 0 shows the whole trial.`;
      const canvas = made("div", { class: "canvas", role: "img", tabindex: "0", "aria-label": label });
      // A stimulus lies directly below the figure above it, whose time axis it carries.
      const carries = !this.data.panels[index + 1]?.stimulus;
      const height = (panel.stimulus ? HEIGHT_STIMULUS : HEIGHT) + (carries ? HEIGHT_AXIS : 0);
      canvas.style.minHeight = height + "px";
      const entries = panel.groups.map((group, number) => this.entry(panel, group, number, index));
      const caption = made("figcaption", {}, `${panel.title}, ${panel.unit}`);
      canvas.addEventListener("keydown", (event) => this.key_down(event));
      const keys = made("div", { class: "keys" }, ...entries.map((entry) => entry.button));
      const figure = made("figure", { class: panel.stimulus ? "plot stimulus" : "plot" }, caption, keys, canvas);
      return { figure, canvas, entries, on: panel.groups.map(() => true), height, carries };
    }

    entry(panel, group, number, index) {
      const [name, width, dash, opacity] = PENS[group.ink];
      const swatch = group.area ? made("span", { class: "mark area", "aria-hidden": "true" }) : line_swatch(group.ink, width, dash);
      const value = made("span", { class: "value" });
      const button = made("button", { type: "button", "aria-pressed": "true" }, swatch, made("span", {}, group.text), value);
      button.addEventListener("click", () => this.toggle(index, number));
      const paint = () => {
        if (group.area) swatch.style.background = colour(this.section, name, opacity);
        else swatch.style.color = colour(this.section, name, opacity);
      };
      return { button, value, paint };
    }

    toggle(index, number) {
      const host = this.hosts[index], plot = this.plots[index], panel = this.data.panels[index];
      host.on[number] = !host.on[number];
      host.entries[number].button.setAttribute("aria-pressed", String(host.on[number]));
      if (!plot) return;
      plot.batch(() => panel.series.forEach((series, place) => {
        if (series.g === number) plot.setSeries(place + 1, { show: host.on[number] });
      }));
      plot.redraw(false, true);
    }

    key_down(event) {
      const acts = {
        ArrowLeft: () => this.shift(-0.1), ArrowRight: () => this.shift(0.1), "+": () => this.scale(0.5), "-": () => this.scale(2),
        0: () => this.zoom(this.first, this.last),
      };
      const act = event.ctrlKey || event.metaKey || event.altKey ? undefined : acts[event.key];
      if (act) { event.preventDefault(); act(); }
    }

    scale(factor, around = (this.from + this.to) / 2) {
      this.zoom(around + (this.from - around) * factor, around + (this.to - around) * factor);
    }

    shift(share) {
      const span = this.to - this.from;
      const by = Math.min(Math.max(share * span, this.first - this.from), this.last - this.to);
      this.zoom(this.from + by, this.to + by);
    }

    zoom(from, to) {
      const least = (this.last - this.first) * 1e-5;
      if (!(to - from >= least)) return;
      this.from = Math.max(from, this.first);
      this.to = Math.min(to, this.last);
      for (const plot of this.plots) plot.setScale("x", { min: this.from, max: this.to });
      this.say();
    }

    say(at) {
      const span = this.to - this.from;
      this.bar.dataset.from = this.from;
      this.bar.dataset.to = this.to;
      this.time.textContent = at == null ? `${shown(this.from, span)} to ${shown(this.to, span)} ms` : `${shown(at, span)} ms`;
    }

    build() {
      const x = unpack(this.data.t);
      this.plots = this.data.panels.map((panel, index) => this.plot(panel, this.hosts[index], x));
      this.paint();
      new ResizeObserver(() => this.plots.forEach((plot, index) => plot.setSize(this.size(this.hosts[index])))).observe(this.root);
      this.root.dataset.ready = "true";
    }

    size(host) {
      return { width: Math.max(200, host.canvas.clientWidth), height: host.height };
    }

    paint() {
      for (const host of this.hosts) for (const entry of host.entries) entry.paint();
      for (const plot of this.plots) plot.redraw(false, true);
    }

    plot(panel, host, x) {
      const stepped = uPlot.paths.stepped({ align: 1 });
      const pen = (group, place) => PENS[panel.groups[group].ink][place];
      const paint = (group) => () => colour(this.section, pen(group, 0), pen(group, 3) ?? 1);
      const lines = panel.series.map((series) => unpack(series.y));
      const series = panel.series.map((series) => {
        const edge = series.role === "edge";
        return {
          show: host.on[series.g], points: { show: false }, width: pen(series.g, 1), dash: edge ? [] : pen(series.g, 2) ?? [],
          stroke: !edge ? paint(series.g) : pen(series.g, 1) ? () => colour(this.section, pen(series.g, 0), 0.75) : "transparent", paths: series.step ? stepped : undefined, spanGaps: false,
        };
      });
      const axis = (extra) => ({
        stroke: () => colour(this.section, "--muted"), grid: { stroke: () => colour(this.section, "--hair"), width: 1 },
        ticks: { stroke: () => colour(this.section, "--hair"), width: 1 }, font: "12px system-ui, sans-serif", ...extra,
      });
      const numbers = (plot, splits) => splits.map((value) => value == null ? "" : String(+value.toPrecision(9)).replace("-", "−"));
      const times = host.carries ? { values: numbers, size: 28, label: "time, ms", labelSize: 16, labelGap: 1, labelFont: "12px system-ui, sans-serif" }
        : { values: (plot, splits) => splits.map(() => ""), size: 6 };
      const options = {
        ...this.size(host), legend: { show: false }, padding: [8, 24, 0, 0],
        scales: { x: { time: false, range: () => [this.from, this.to] }, y: { range: (plot, low, high) => this.range(panel, low, high) } },
        axes: [axis(times), axis({ values: numbers, size: WIDTH_AXIS, space: panel.stimulus ? 22 : 30 })],
        series: [{}, ...series],
        bands: panel.bands.map(([upper, lower, group]) => ({ series: [upper + 1, lower + 1], fill: paint(group) })),
        cursor: {
          y: false, points: { show: false }, drag: { x: true, y: false, setScale: false },
          sync: { key: this.key, setSeries: false, filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        },
        hooks: {
          drawClear: [(plot) => this.spans(plot, panel, host)],
          draw: [(plot) => this.marks(plot, panel, host)],
          setCursor: [(plot) => this.values(plot, panel, host, lines, x)],
          setSelect: [(plot) => this.select(plot)],
          ready: [(plot) => this.listen(plot)],
        },
      };
      return new uPlot(options, [x, ...lines], host.canvas);
    }

    range(panel, low, high) {
      if (low == null || high == null) return [0, 1];
      const whole = this.from <= this.first && this.to >= this.last;
      // Zoomed in, the range shows the form of the curve, not its distance from zero.
      if (panel.zero && whole) { low = Math.min(low, 0); high = Math.max(high, 0); }
      const span = Math.max(high - low, panel.least * (this.to - this.from) / (this.last - this.first));
      const air = panel.zero && whole ? 0 : (span - (high - low)) / 2;
      return [panel.zero && whole && low === 0 ? 0 : low - air - 0.06 * span, low - air + 1.08 * span];
    }

    spans(plot, panel, host) {
      const { left, top, width, height } = plot.bbox;
      plot.ctx.save();
      plot.ctx.beginPath();
      plot.ctx.rect(left, top, width, height);
      plot.ctx.clip();
      for (const [group, from, to] of panel.spans) {
        if (!host.on[group]) continue;
        const [name, , , opacity] = PENS[panel.groups[group].ink];
        const start = plot.valToPos(from, "x", true), end = plot.valToPos(to, "x", true);
        plot.ctx.fillStyle = colour(this.section, name, opacity);
        plot.ctx.fillRect(start, top, Math.max(1, end - start), height);
      }
      plot.ctx.restore();
    }

    marks(plot, panel, host) {
      const { top, height } = plot.bbox;
      for (const [group, at] of panel.marks) {
        if (!host.on[group] || at < this.from || at > this.to) continue;
        const [name, width, dash] = PENS[panel.groups[group].ink];
        const place = plot.valToPos(at, "x", true);
        plot.ctx.save();
        plot.ctx.strokeStyle = colour(this.section, name);
        plot.ctx.lineWidth = width * devicePixelRatio;
        plot.ctx.setLineDash((dash ?? []).map((length) => length * devicePixelRatio));
        plot.ctx.beginPath();
        plot.ctx.moveTo(place, top);
        plot.ctx.lineTo(place, top + height);
        plot.ctx.stroke();
        plot.ctx.restore();
      }
      const labels = [];
      for (const [group, at, value, text] of panel.points) {
        if (!host.on[group] || at < this.from || at > this.to) continue;
        const { left, width } = plot.bbox, ratio = devicePixelRatio;
        const x = plot.valToPos(at, "x", true), y = plot.valToPos(value, "y", true);
        const right = x - left < 0.6 * width;
        plot.ctx.save();
        plot.ctx.fillStyle = colour(this.section, PENS[panel.groups[group].ink][0]);
        plot.ctx.beginPath();
        plot.ctx.arc(x, y, 4.5 * ratio, 0, 2 * Math.PI);
        plot.ctx.fill();
        plot.ctx.font = `600 ${12 * ratio}px system-ui, sans-serif`;
        plot.ctx.textAlign = right ? "left" : "right";
        plot.ctx.textBaseline = "middle";
        const start = x + (right ? 9 : -9) * ratio, wide = plot.ctx.measureText(text).width;
        const [from, to] = right ? [start, start + wide] : [start - wide, start];
        const [first, last] = [from, to].map((pixel) => plot.valToIdx(plot.posToVal(pixel, "x", true)));
        const values = plot.series.flatMap((series, number) => number && series.show ? [...plot.data[number].slice(first, last + 1)] : []);
        // A place inside the plot, over no other label, over few values, near its point.
        const cost = (rise) => {
          const middle = y - rise * ratio, is_near = (other) => Math.abs(other - middle) < 8 * ratio;
          if (middle < top + 8 * ratio || middle > top + height - 8 * ratio) return Infinity;
          const covered = labels.filter((other) => other.from < to && from < other.to && Math.abs(other.middle - middle) < 14 * ratio);
          const crossed = values.filter((known) => known != null && is_near(plot.valToPos(known, "y", true)));
          return 1e6 * covered.length + crossed.length + Math.abs(rise) / 8;
        };
        const rise = [12, -12, 26, -26, 40, -40].reduce((best, rise) => cost(rise) < cost(best) ? rise : best);
        const place = [start, y - rise * ratio];
        labels.push({ from, to, middle: place[1] });
        plot.ctx.lineWidth = 4 * ratio;
        plot.ctx.lineJoin = "round";
        plot.ctx.strokeStyle = colour(this.section, "--card", 0.85);
        plot.ctx.strokeText(text, ...place);
        plot.ctx.fillText(text, ...place);
        plot.ctx.restore();
      }
    }

    values(plot, panel, host, lines, x) {
      const at = plot.cursor.idx;
      const span = plot.scales.y.max - plot.scales.y.min;
      panel.groups.forEach((group, number) => {
        const found = panel.series.map((series, place) => series.g === number && series.role !== "trial" ? lines[place][at] : null);
        const known = at == null ? [] : found.filter((value) => value != null);
        const texts = (group.area ? known.reverse() : known.slice(0, 1)).map((value) => shown(value, span));
        host.entries[number].value.textContent = texts.join(" … ");
      });
      if (plot === this.plots[0]) this.say(at == null ? undefined : x[at]);
    }

    select(plot) {
      const { left, width } = plot.select;
      if (width >= 4) this.zoom(plot.posToVal(left, "x"), plot.posToVal(left + width, "x"));
      if (width > 0) plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    }

    // The wheel with Ctrl zooms, with Shift it moves; dragging with Shift moves; a double click shows the whole trial.
    listen(plot) {
      plot.over.addEventListener("wheel", (event) => {
        if (event.ctrlKey || event.metaKey) this.scale(event.deltaY > 0 ? 1.25 : 0.8, plot.posToVal(event.offsetX, "x"));
        else if (event.shiftKey) this.shift(0.1 * Math.sign(event.deltaY || event.deltaX));
        else return;
        event.preventDefault();
      }, { passive: false });
      plot.over.addEventListener("dblclick", () => this.zoom(this.first, this.last));
      plot.over.addEventListener("mousedown", (event) => {
        if (!event.shiftKey) return;
        event.stopImmediatePropagation();
        let before = event.clientX;
        const move = (event) => {
          this.shift((before - event.clientX) / plot.over.clientWidth);
          before = event.clientX;
        };
        addEventListener("mousemove", move);
        addEventListener("mouseup", () => removeEventListener("mousemove", move), { once: true });
      }, { capture: true });
    }
  }

  // A scenario is unpacked and drawn when it becomes visible.
  const scenarios = [];
  const visible = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      visible.unobserve(target);
      const script = target.querySelector("script.curves");
      let scenario;
      try {
        scenario = new Scenario(target, JSON.parse(script.textContent), target.id);
        script.before(scenario.root);
        scenario.build();
        scenarios.push(scenario);
      } catch (fault) {
        scenario?.root.remove();
        target.classList.add("undrawn");
        console.error(fault);
      }
    }
  }, { rootMargin: "400px" });
  document.querySelectorAll("script.curves").forEach((script) => visible.observe(script.closest(".scenario")));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scenarios.forEach((scenario) => scenario.paint()));
})();
