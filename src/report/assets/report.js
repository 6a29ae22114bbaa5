"use strict";
// Fills the page from the JSON in #report. Text enters through textContent only, formulas as parsed XML.
(() => {
  const reports = JSON.parse(document.getElementById("report").textContent);
  let report = reports[0];  // that is shown
  const byId = (id) => document.getElementById(id);

  /** An element with attributes (class, text, …) and children; what is null is left out. */
  function make(tag, attributes = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (value === null || value === undefined) continue;
      if (name === "text") element.textContent = value;
      else element.setAttribute(name, value);
    }
    element.append(...children.filter((child) => child !== null && child !== undefined));
    return element;
  }

  const missing = "–";
  /** As printf's %.6g writes it. */
  function format(value, digits = 6) {
    if (value === null || value === undefined || !Number.isFinite(value)) return missing;
    if (value === 0) return "0";
    const exponent = Math.floor(Math.log10(Math.abs(Number(value.toPrecision(digits)))));
    if (exponent < -4 || exponent >= digits) {
      const [mantissa, power] = value.toExponential(digits - 1).split("e");
      return `${mantissa.replace(/\.?0+$/, "")}e${power}`;
    }
    const text = value.toPrecision(digits);
    return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
  }
  const percent = (share) => (share === null || share === undefined ? missing : `${format(100 * share, 3)} %`);
  /** Of what is known; NaN where nothing is. */
  const rms = (values) => {
    const known = values.filter((value) => value !== null);
    return Math.sqrt(known.reduce((sum, value) => sum + value * value, 0) / known.length);
  };
  const apart = (a, b) => rms(a.map((value, i) => (value === null || b[i] === null ? null : value - b[i])));
  /** Digits that tell values of a range apart: more than 4 where it is far from 0. */
  const digitsOf = (min, max) => Math.min(15, Math.max(4, 3 + Math.ceil(Math.log10(Math.max(Math.abs(min), Math.abs(max)) / (max - min || 1)))));

  // ---- tables -------------------------------------------------------------------------------------------------------------

  /** columns: {label, number, wrap}; a cell is a number (shown to six digits), text, or a node. */
  function table(caption, columns, rows, mark = () => false) {
    const head = make("tr", {}, ...columns.map((column) => make("th", { scope: "col", class: column.number ? "number" : null, text: column.label })));
    const body = rows.map((row, r) =>
      make("tr", { class: mark(r) ? "marked" : null }, ...row.map((value, k) => {
        const numeric = columns[k].number;
        const cell = make(k === 0 ? "th" : "td", { class: numeric ? "number" : columns[k].wrap ? "wrap" : null, scope: k === 0 ? "row" : null });
        if (value instanceof Node) cell.append(value);
        else if (typeof value === "number") {
          cell.textContent = format(value);
          cell.setAttribute("data-value", String(value));
          cell.title = String(value);
        } else cell.textContent = value === null || value === undefined ? missing : value;
        return cell;
      })));
    const scroll = make("div", { class: "scroll" }, make("table", { "aria-label": caption }, make("thead", {}, head), make("tbody", {}, ...body)));
    return scrollable(scroll, caption);
  }

  /** A box that scrolls sideways can be reached by keyboard exactly while it has something to scroll. */
  function scrollable(box, label) {
    new ResizeObserver(() => {
      const overflows = box.scrollWidth > box.clientWidth + 1;
      if (overflows) {
        box.tabIndex = 0;
        box.setAttribute("role", "region");
        box.setAttribute("aria-label", `${label}, scrolls sideways`);
      } else {
        for (const name of ["tabindex", "role", "aria-label"]) box.removeAttribute(name);
      }
    }).observe(box);
    return box;
  }

  const badge = (text, kind = "") => make("span", { class: `badge ${kind}`, text });

  function formula(xml, label) {
    const parsed = new DOMParser().parseFromString(xml, "application/xml");
    return scrollable(make("div", { class: "scroll formula" }, document.importNode(parsed.documentElement, true)), label);
  }

  function definitions(rows) {
    const list = make("dl", { class: "rows" });
    for (const [label, value] of rows) list.append(make("dt", { text: label }), make("dd", {}, value));
    return list;
  }

  // ---- what was fitted ----------------------------------------------------------------------------------------------------

  let { fit, model } = report;
  /** A quantity with the unit that the model file states, of a label its last word. */
  function withUnit(label, quantity = label.split(" ").pop()) {
    const name = quantity.split("@")[0];
    return Object.hasOwn(model.units, name) ? `${label} [${model.units[name]}]` : label;
  }
  let test = report.data.find((data) => data.test);

  function fillHeader() {
    const rows = report.observations.reduce((sum, group) => sum + group.n, 0);
    byId("lead").textContent = `Fitted to ${rows} rows of ${report.source} by gp2 ${report.library}${report.date ? `; file of ${report.date}` : ""}.`;
    const tiles = [["Optimiser", fit.converged ? "converged" : fit.iterations === 0 ? "did not run" : "not converged", `${fit.iterations} iterations, best of ${fit.restarts.length} restarts`],
      ["Negative log likelihood", format(fit.nll), fit.rows_are_those_of_fit ? `of ${rows} rows` : "at the last fit or shoot; rows may have changed since"]];
    const shown = test || report.data[0];
    if (shown) {
      const e = shown.figures;
      tiles.push([`Error, ${shown.name}`, e.rmse_normalised === null ? format(e.nrmse, 3) : format(e.rmse_normalised, 3), e.rmse_normalised === null ? "rms error / spread" : "rms error / training spread"],
        [`95 % coverage, ${shown.name}`, percent(e.coverage95), "measurement noise included"],
        ["Constraint error", format(e.max_constraint_error_fitted, 2), "largest |A q̈ − b|"]);
    }
    byId("tiles").append(...tiles.map(([label, value, more]) =>
      make("div", {}, make("dt", { text: label }), make("dd", {}, value, make("small", { text: more })))));
    for (const section of document.querySelectorAll("main section")) {
      byId("sections").append(make("li", {}, make("a", { href: `#${section.id}`, text: section.querySelector("h2").textContent })));
    }
    byId("colophon").textContent = `Written by gp2 ${report.version}. ${Object.keys(model.units).length ? "Units are those of the model file, and those that angles and joints have." : "The model file states no units: axes are in those of the log."} This file is complete; it loads nothing.`;
  }

  function fillAdvice() {
    const words = { warning: "To mend", note: "Good to know", good: "All well" };
    byId("advice-list").append(...report.advice.map((one) =>
      make("li", { class: one.level }, make("span", { class: "kind", text: words[one.level] }),
        make("p", { class: "found", text: one.text }), one.mend ? make("p", { text: one.mend }) : null)));
  }

  function fillModel() {
    const rows = [["model file", make("code", { text: model.file })], ["coordinates", model.coordinates.map((name) => withUnit(name)).join(", ")]];
    if (model.inputs.length) rows.push(["inputs", model.inputs.map((name) => withUnit(name)).join(", ")]);
    rows.push(...report.prior);
    for (const group of report.observations) {
      const noise = group.noise.map((value) => format(value, 4));
      const same = noise.every((value) => value === noise[0]);
      rows.push(["learned from", `${group.names.join(", ")} at ${group.n} states${group.system ? ` of '${group.system}'` : ""}; noise ${same ? noise[0] : noise.join(", ")}${group.estimated ? ", estimated" : ""}`]);
    }
    if (report.truth) rows.push(["truth", `[truth] of '${report.truth}'`]);
    byId("model-summary").append(definitions(rows));

    const constraints = byId("constraints");
    if (!model.constraints.length) {
      constraints.append(make("p", { class: "muted", text: "None: the acceleration is the unconstrained one." }));
    } else {
      const switched = model.constraints.some((row) => row.when);
      const when = (row) => (row.when ? make("span", {}, row.contact ? "a contact, while " : "while ", make("code", { text: row.when })) : "always");
      constraints.append(table("Constraints as written", [{ label: "as written" }, { label: "level" }, ...(switched ? [{ label: "holds" }] : [])],
        model.constraints.map((row) => [make("code", { text: `${row.text} = 0` }), row.level, ...(switched ? [when(row)] : [])])));
      constraints.append(make("p", { text: "Differentiated along the motion they become A q̈ = b with" }));
      for (const name of ["A", "b"]) {
        constraints.append(model[name] ? formula(model[name], `The matrix ${name}`) : make("p", { class: "muted", text: `${name} is too long to typeset: gp2 show prints it.` }));
      }
    }

    const bound = (row) => (row.at_bound ? badge("at its bound") : "");
    const estimated = report.parameters.some((row) => row.fitted !== undefined);
    const parameters = byId("parameters");
    if (!report.parameters.length) {
      parameters.append(make("p", { class: "muted", text: "None." }));
    } else if (!estimated) {
      parameters.append(table("Parameters of the system", [{ label: "parameter" }, { label: "held at", number: true }], report.parameters.map((row) => [withUnit(row.name), row.model])));
    } else {
      parameters.append(table("Parameters of the system", [{ label: "parameter" }, { label: "in the model file", number: true }, { label: "fitted", number: true }, { label: "standard error", number: true }, { label: "lower bound", number: true }, { label: "upper bound", number: true }, { label: "" }],
        report.parameters.map((row) => [withUnit(row.name), row.model, row.fitted === undefined ? "held" : row.fitted, row.stddev, row.lower, row.upper, bound(row)]), (r) => report.parameters[r].at_bound));
    }
    const drawn = fit.draws ? [{ label: "2.5 % of draws", number: true }, { label: "97.5 % of draws", number: true }] : [];
    byId("hyperparameters").append(table("Hyperparameters", [{ label: "name" }, { label: "value", number: true }, ...drawn, { label: "lower bound", number: true }, { label: "upper bound", number: true }, { label: "unit" }, { label: "" }],
      report.hyperparameters.map((row) => [row.name, row.value, ...(row.drawn95 || []), row.lower, row.upper, row.unit, bound(row)]), (r) => report.hyperparameters[r].at_bound));
  }

  function fillOptimiser() {
    const again = fit.restarts[fit.best_restart];
    byId("optimiser-lead").textContent = `${fit.termination.charAt(0).toUpperCase()}${fit.termination.slice(1)}, after ${fit.iterations} iterations. ` +
      `Negative log likelihood ${format(fit.nll)}; with hyper-priors, the objective, ${format(fit.objective)}.` +
      (fit.rows_are_those_of_fit ? "" : " Both are those at the last fit or shoot; rows may have been added or taken away since.") +
      (again && again.objective !== null && again.objective - fit.objective > 1e-9 * Math.abs(fit.objective) ? " A scan from the best restart found a lower optimum than the restarts." : "") +
      (fit.draws ? ` Predictions mix ${fit.draws.n} draws of the hyperparameters by ${fit.draws.n_chains} chains: R̂ at most ${format(fit.draws.r_hat, 3)}, worth ${format(fit.draws.effective_size, 3)} independent ones or more.` : "");
    byId("restarts").append(table("Restarts of the optimiser", [{ label: "restart" }, { label: "objective", number: true }, { label: "neg. log likelihood", number: true }, { label: "iterations", number: true }, { label: "evaluations", number: true }, { label: "failed", number: true }, { label: "why it stopped", wrap: true }],
      fit.restarts.map((one, k) => [k === fit.best_restart ? make("span", {}, `${k + 1} `, badge("best", "good")) : String(k + 1), one.objective === null ? "∞" : one.objective, one.nll === null ? "∞" : one.nll, one.iterations, one.evaluations, one.failed, one.termination])));
  }

  function fillFigures() {
    if (!report.data.length) {
      byId("figures").append(make("p", { class: "muted", text: "The fit learned from no acceleration, and no test data were given." }));
      return;
    }
    const outputs = [...new Set(report.data.flatMap((data) => data.outputs))];
    const of = (get) => report.data.map((data) => get(data.figures));
    const at = (list, output) => of((e) => { const k = e.outputs.indexOf(output); return k < 0 ? null : e[list][k]; });
    const rows = [["points", ...of((e) => e.n)]];
    for (const output of outputs) rows.push([`rmse ${withUnit(output)}`, ...at("rmse", output)]);
    if (report.truth) for (const output of outputs) rows.push([`rmse ${withUnit(output)}, truth`, ...at("rmse_to_truth", output)]);
    rows.push(["rmse / training std", ...of((e) => e.rmse_normalised)],
      ["nrmse", ...of((e) => e.nrmse)],
      ["nlpd, with noise", ...of((e) => e.nlpd)],
      ["50 % coverage, with noise", ...of((e) => e.coverage50)],
      ["80 % coverage, with noise", ...of((e) => e.coverage80)],
      ["95 % coverage, with noise", ...of((e) => e.coverage95)],
      ["nlpd, without noise", ...of((e) => e.nlpd_latent)],
      ["50 % coverage, without noise", ...of((e) => e.coverage50_latent)],
      ["80 % coverage, without noise", ...of((e) => e.coverage80_latent)],
      ["95 % coverage, without noise", ...of((e) => e.coverage95_latent)],
      ["points far from the data", ...of((e) => e.n_far)],
      ["nrmse near the data", ...of((e) => e.nrmse_near)],
      ["nrmse far from them", ...of((e) => e.nrmse_far)],
      ["max |A q̈ − b|, model", ...of((e) => e.max_constraint_error)],
      ["max |A q̈ − b|, fitted", ...of((e) => e.max_constraint_error_fitted)]);
    byId("figures").append(table("Figures of quality", [{ label: "figure" }, ...report.data.map((data) => ({ label: data.name, number: true }))], rows));
    byId("figures").append(make("dl", { class: "rows muted" }, ...[
      ["rmse", "root mean square error, in the units of the output" + (report.truth ? "; “truth” compares with the true acceleration, free of noise" : "")],
      ["rmse / training std", "mean over outputs"], ["nrmse", "rms error over the rms of the spreads of these data; above 1 their mean predicts better"],
      ["nlpd, coverage", "mean negative log density, and share within the central 50, 80 and 95 %; “with noise” is right for measurements, “without noise” for targets free of noise"],
      ["max |A q̈ − b|", "of the predicted mean, with the parameters of the model file and with the fitted ones"],
    ].flatMap(([label, value]) => [make("dt", { text: label }), make("dd", { text: value })])));
    const list = report.data.map((data) => `${data.name}: ${data.source}`).join("; ");
    byId("figures").append(make("p", { class: "muted", text: `Data – ${list}.` }));
    if (report.left_out) byId("figures").append(make("p", { id: "left-out", text: `Training data ${report.left_out}.` }));
  }

  // ---- charts -------------------------------------------------------------------------------------------------------------

  const live = new Map();  // host -> what to do to take its chart away
  let redrawn = [];  // what draws the charts of the fit that is shown
  const lasting = [];  // what draws the charts of all fits
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const font = '12px system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif';

  function clear(host) {
    if (live.has(host)) live.get(host)();
    live.delete(host);
    host.replaceChildren();
  }

  function padded(min, max, share) {
    if (min === null || max === null || !Number.isFinite(min) || !Number.isFinite(max)) return [0, 1];
    // a range of rounding errors has no ticks
    const size = Math.max(Math.abs(min), Math.abs(max));
    const pad = max - min > 1e-9 * size ? share * (max - min) : 0.1 * size || 1;
    return [min - pad, max + pad];
  }

  function frame(host, spec) {
    const legend = spec.series.length > 1 || spec.band ? make("ul", { class: "legend" }, ...spec.series.flatMap((series) => {
      const items = [make("li", {}, make("span", { class: `swatch ${series.kind === "line" ? "line" : series.hollow ? "hollow" : ""}`, style: `background:${colour(series.colour)};border-color:${colour(series.colour)}` }), series.label)];
      if (series.low) items.push(make("li", {}, make("span", { class: "swatch band", style: `background:${colour(series.band || "--band")}` }), "±2 std"));
      return items;
    })) : null;
    const plot = make("div", { class: "plot", role: "img", "aria-label": `${spec.title}. ${spec.summary}` });
    const readout = make("div", { class: "readout", "aria-hidden": "true" });
    host.append(make("figure", {}, make("figcaption", {}, make("strong", { text: spec.title }), make("span", { class: "summary", text: spec.summary })), legend, plot, readout));
    return { plot, readout };
  }

  /**
   * A chart by uPlot. spec: {title, summary, x: {label, values, quantity}, y: {label, log, zero, quantity}, square, diagonal, height, trace,
   * series: [{label, values, colour, kind: "points" | "line", hollow, steps, low, high}]}; low and high are a band or error bars.
   * trace: a line from point to point in the order of the data; marks: values of x that are marked at the foot.
   */
  function chart(host, spec) {
    clear(host);
    const { plot, readout } = frame(host, spec);
    const order = spec.x.values.map((_, i) => i).filter((i) => spec.x.values[i] !== null);
    order.sort((a, b) => spec.x.values[a] - spec.x.values[b]);
    const pick = (values) => order.map((i) => values[i]);
    const data = [pick(spec.x.values)];
    const series = [{}];
    const bands = [];
    const bars = [];
    for (const one of spec.series) {
      const ink = colour(one.colour);
      const size = (order.length > 400 ? 0.7 : 1) * (one.size || 5);
      if (one.low) {
        const hidden = { points: { show: false }, stroke: "transparent", width: 0, spanGaps: true, pxAlign: 0 };
        if (one.kind !== "line") hidden.paths = () => null;
        series.push({ ...hidden, label: "" }, { ...hidden, label: "" });
        data.push(pick(one.high), pick(one.low));
        if (one.kind === "line") bands.push({ series: [series.length - 2, series.length - 1], fill: colour(one.band || "--band") });
        else bars.push({ high: series.length - 2, low: series.length - 1, ink });
      }
      series.push(one.kind === "line"
        ? { label: one.label, stroke: ink, width: 1.75, dash: one.dash, spanGaps: one.spanned, pxAlign: 0, points: { show: false }, ...(one.steps ? { paths: uPlot.paths.stepped({ align: 1 }) } : {}) }
        : { label: one.label, stroke: ink, paths: () => null, points: { show: true, space: 0, size, width: one.hollow ? 1.4 : 0, stroke: ink, fill: one.hollow ? "transparent" : ink } });
      data.push(pick(one.values));
    }
    const ratio = () => devicePixelRatio || 1;
    // horizontal, vertical or sloping lines behind the points, and error bars
    const behind = (u) => {
      const { ctx } = u;
      ctx.save();
      ctx.beginPath();
      ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
      ctx.clip();
      ctx.lineWidth = ratio();
      if (spec.diagonal || spec.y.zero) {
        const { min, max } = u.scales.x;
        ctx.strokeStyle = colour("--muted");
        ctx.beginPath();
        ctx.moveTo(u.valToPos(min, "x", true), u.valToPos(spec.diagonal ? min : 0, "y", true));
        ctx.lineTo(u.valToPos(max, "x", true), u.valToPos(spec.diagonal ? max : 0, "y", true));
        ctx.stroke();
      }
      if (spec.trace) {
        ctx.strokeStyle = colour("--c1");
        ctx.globalAlpha = 0.5;
        ctx.beginPath();
        spec.x.values.forEach((x, i) => ctx.lineTo(u.valToPos(x, "x", true), u.valToPos(spec.series[0].values[i], "y", true)));
        ctx.stroke();
      }
      if (spec.marks) {
        ctx.strokeStyle = colour("--muted");
        ctx.globalAlpha = 0.6;
        ctx.beginPath();
        const foot = u.bbox.top + u.bbox.height;
        for (const x of spec.marks) {
          const at = u.valToPos(x, "x", true);
          ctx.moveTo(at, foot - 7 * ratio());
          ctx.lineTo(at, foot);
        }
        ctx.stroke();
      }
      for (const { high, low, ink } of bars) {
        ctx.strokeStyle = ink;
        ctx.globalAlpha = 0.35;
        ctx.lineWidth = 1.5 * ratio();
        ctx.beginPath();
        u.data[0].forEach((x, i) => {
          if (u.data[high][i] === null || u.data[low][i] === null) return;
          const at = u.valToPos(x, "x", true);
          ctx.moveTo(at, u.valToPos(u.data[high][i], "y", true));
          ctx.lineTo(at, u.valToPos(u.data[low][i], "y", true));
        });
        ctx.stroke();
      }
      ctx.restore();
    };
    const both = spec.square ? padded(...data.flat().filter((v) => v !== null).reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]), 0.05) : null;
    const width = () => Math.max(plot.clientWidth, 120);
    const height = () => (spec.square ? Math.min(width(), 340) : spec.height || (width() < 480 ? 240 : 280));
    const written = (u, scale, value) => format(value, digitsOf(u.scales[scale].min, u.scales[scale].max));
    const axis = (label, scale, extra) => ({
      label, font, labelFont: font, labelSize: 20, stroke: colour("--muted"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--grid"), width: 1, size: 4 },
      values: (u, splits) => splits.map((v) => (v === null || v === undefined ? "" : written(u, scale, v))), ...extra });
    const yRange = (u, min, max) => {
      if (both) return both;
      if (spec.y.range) return spec.y.range;
      if (spec.y.zero && min !== null) { const top = Math.max(Math.abs(min), Math.abs(max)); return padded(-top, top, 0.08); }
      return padded(min, max, 0.08);
    };
    // lines at powers of ten only, six at most
    const decades = (u) => {
      const first = Math.ceil(Math.log10(u.scales.y.min) - 1e-9), last = Math.floor(Math.log10(u.scales.y.max) + 1e-9);
      const step = Math.max(1, Math.ceil((last - first) / 6));
      return numbers(Math.max(last - first + 1, 0)).filter((k) => k % step === 0).map((k) => 10 ** (first + k));
    };
    const chartOptions = {
      width: width(), height: height(), series, bands, padding: [8, 10, 0, 0],
      legend: { show: false },
      cursor: { drag: { x: true, y: false }, points: { size: 8 } },
      scales: { x: { time: false, range: (u, min, max) => both || spec.x.range || padded(min, max, 0.03) }, y: spec.y.log ? { distr: 3 } : { range: yRange } },
      axes: [axis(withUnit(spec.x.label, spec.x.quantity), "x", { size: 34, space: (u, k, min, max) => Math.max(50, 8 * digitsOf(min, max)) }),
        axis(withUnit(spec.y.label, spec.y.quantity), "y", { size: (u, labels) => Math.max(50, ...(labels || []).map((text) => 10 + 6 * text.length)), ...(spec.y.log ? { splits: decades } : {}) })],
      hooks: {
        drawAxes: [behind],
        setCursor: [(u) => {
          const i = u.cursor.idx;
          if (i === null || i === undefined) { readout.textContent = ""; return; }
          const parts = u.series.slice(1).map((one, k) => [one.label, u.data[k + 1][i]]).filter(([label, value]) => label && value !== null && value !== undefined);
          readout.textContent = [`${spec.x.label} ${written(u, "x", u.data[0][i])}`, ...parts.map(([label, value]) => `${label} ${written(u, "y", value)}`)].join("  ·  ");
        }],
      },
    };
    const u = new uPlot(chartOptions, data, plot);
    const watch = new ResizeObserver(() => {
      if (Math.abs(u.width - width()) > 1) u.setSize({ width: width(), height: height() });
    });
    watch.observe(plot);
    live.set(host, () => { watch.disconnect(); u.destroy(); });
  }

  function note(host, text) {
    clear(host);
    host.append(make("p", { class: "muted", text }));
  }

  function options(select, names, keep) {
    select.replaceChildren(...names.map(([value, label]) => make("option", { value, text: label })));
    if (names.some(([value]) => value === keep)) select.value = keep;
  }

  let data = test || report.data[0];
  const numbers = (n) => Array.from({ length: n }, (_, i) => i);
  /** time where the data have it, else the number of the row */
  function along() {
    const t = data.columns.t;
    if (t && t.some((value) => value !== t[0])) return { label: "t [s]", values: t, ordered: t.every((value, i) => i === 0 || value >= t[i - 1]) };
    return { label: "row", values: data.measured[0].map((_, i) => 1 + i * data.stride), ordered: false };
  }
  const predictedOutput = (k) => data.predicted[data.rows[k]];

  /** Keeps n charts in the host. */
  function keep(host, n) {
    while (host.children.length > n) { clear(host.lastChild); host.lastChild.remove(); }
    while (host.children.length < n) host.append(make("div"));
    return host;
  }

  const band = (mean, std, sign) => mean.map((value, i) => (value === null || std[i] === null ? null : value + sign * 2 * std[i]));

  const reach = (one) => Math.max(...one.mean) - Math.min(...one.mean);

  function drawLearned() {
    const shown = report.learned.filter((one) => one.name === byId("learned-force").value).sort((a, b) => reach(b) - reach(a));
    const range = shown.flatMap((one) => [...band(one.mean, one.stddev, -1), ...band(one.mean, one.stddev, 1)]);
    const y = { label: shown[0].name.split("@")[0], range: padded(Math.min(...range), Math.max(...range), 0.08) };
    const host = keep(byId("learned-charts"), shown.length);
    shown.forEach((one, k) => chart(host.children[k], {
      title: `${one.name} along ${one.along}`, summary: `From ${format(Math.min(...one.mean), 3)} to ${format(Math.max(...one.mean), 3)}, band of ±${format(2 * rms(one.stddev), 3)} on average.`,
      x: { label: one.along, quantity: one.along, values: one.at }, y, band: true, marks: one.data,
      series: [{ label: "learned", values: one.mean, colour: "--c1", kind: "line", low: band(one.mean, one.stddev, -1), high: band(one.mean, one.stddev, 1) }],
    }));
  }

  function fillLearned() {
    if (!report.learned.length) return;
    // what the data determine best comes first
    const known = (one) => reach(one) / rms(one.stddev);
    const names = new Set([...report.learned].sort((a, b) => known(b) - known(a)).map((one) => one.name));
    options(byId("learned-force"), [...names].map((name) => [name, name]));
    byId("learned-force").addEventListener("change", drawLearned);
    drawLearned();
    redrawn.push(drawLearned);
  }

  function drawResiduals() {
    const name = byId("residual-feature").value;
    const x = name === "" ? along() : { label: name, values: data.columns[name] };
    const host = keep(byId("residual-charts"), data.outputs.length);
    data.outputs.forEach((output, k) => {
      const noise = data.noise[k];
      chart(host.children[k], {
        title: output, summary: `rms ${format(data.figures.rmse[k], 3)}${noise === null ? "" : `, fitted noise ${format(noise, 3)}`}`,
        x, y: { label: "residual", quantity: output, zero: true }, series: [{ label: "residual", values: data.residual[k], colour: "--c1", kind: "points" }],
      });
    });
  }

  function drawScatter() {
    const truth = byId("scatter-against").value === "truth";
    const host = keep(byId("scatter-charts"), data.outputs.length);
    data.outputs.forEach((output, k) => {
      const reference = truth ? data.truth[data.rows[k]] : data.measured[k];
      const rmse = truth ? data.figures.rmse_to_truth[k] : data.figures.rmse[k];
      chart(host.children[k], {
        title: output, summary: `rmse ${format(rmse, 3)}; on the line the prediction is exact`, square: true, diagonal: true,
        x: { label: `${truth ? "true" : "measured"} ${output}`, values: reference }, y: { label: `predicted ${output}` },
        series: [{ label: "predicted", values: predictedOutput(k), colour: "--c1", kind: "points" }],
      });
    });
  }

  function drawCalibration() {
    const host = byId("calibration-chart");
    const k = Number(byId("calibration-output").value);
    const shares = data.coverage[k];
    clear(byId("pit-chart"));
    if (shares.every((share) => share === null)) return note(host, "The noise of this output is not known: training did not observe it.");
    const at95 = shares[data.levels.indexOf(0.95)];
    chart(host, {
      title: `Coverage, ${data.name} data`, summary: `${percent(at95)} of the measurements lie within their 95 % interval.`,
      x: { label: "nominal probability", values: data.levels, range: [0, 1] }, y: { label: "share of measurements", range: [0, 1] }, diagonal: true, height: 320,
      series: [{ label: "share within", values: shares, colour: "--c1", kind: "line" }],
    });
    drawPit(k);
  }

  /** Histogram of Φ(z): as densities, so that what is near the data and what is far from them compare. */
  function drawPit(k) {
    const sum = (counts) => counts.reduce((a, b) => a + b, 0);
    const parts = [["near the data", data.pit_near[k], "--c1"], ["far from them", data.pit_far[k], "--c2"]].filter(([, counts]) => sum(counts) > 0);
    const bins = parts[0][1].length;
    const density = (counts) => numbers(bins + 1).map((b) => counts[Math.min(b, bins - 1)] * bins / sum(counts));
    const top = Math.max(2, ...parts.flatMap(([, counts]) => density(counts)));
    const ends = (counts) => percent((counts[0] + counts[bins - 1]) / sum(counts));
    chart(byId("pit-chart"), {
      title: `Where measurements lie in their predictions, ${data.name} data`,
      summary: `${parts.map(([label, counts]) => `${ends(counts)} of ${sum(counts)} values ${label}`).join(", ")} in the outermost two tenths, which should hold 20 %.`,
      x: { label: "predicted probability of less than the measurement", values: numbers(bins + 1).map((b) => b / bins), range: [0, 1] },
      y: { label: "density", range: [0, 1.05 * top] }, height: 220,
      series: [...parts.map(([label, counts, colour]) => ({ label, values: density(counts), colour, kind: "line", steps: true })),
        { label: "calibrated", values: numbers(bins + 1).map(() => 1), colour: "--muted", kind: "line", dash: [4, 4] }],
    });
  }

  function drawConstraint() {
    const host = byId("constraint-chart");
    if (!data.constraint_error.length) return note(host, "The system has no constraints.");
    if (data.constraint_error.flat().every((value) => value === null)) return note(host, "The data lack what the constraint reads.");
    const x = along();
    const floor = 1e-18;
    const palette = ["--c1", "--c2", "--c3", "--c4"];
    chart(host, {
      title: `|A q̈ − b|, ${data.name} data`, summary: `At most ${format(data.largest_constraint_error, 2)}; zeros are drawn at ${floor}.`, x, y: { label: "|A q̈ − b|", log: true },
      series: data.constraint_error.map((row, k) => ({ label: `row ${k + 1}`, values: row.map((v) => (v === null ? null : Math.max(v, floor))), colour: palette[k % 4], hollow: k >= 4, kind: "points" })),
    });
  }

  function drawAccelerations() {
    const j = Number(byId("acceleration-output").value);
    const x = along();
    const kind = x.ordered ? "line" : "points";
    const coordinate = model.coordinates[j];
    const withBand = (label, mean, std) => ({ label, values: mean, colour: "--c1", kind, low: band(mean, std, -1), high: band(mean, std, 1) });
    const series = [withBand("predicted", data.predicted[j], data.stddev[j])];
    const k = data.rows.indexOf(j);
    if (k >= 0) series.unshift({ label: "measured", values: data.measured[k], colour: "--c2", kind: "points", hollow: true, size: 8 });
    if (data.truth) series.push({ label: "true", values: data.truth[j], colour: "--c3", kind, size: 2.5, dash: [6, 4] });
    const width = 2 * rms(data.stddev[j]);
    chart(byId("constrained-chart"), {
      title: `Constrained acceleration dd${coordinate}`, summary: `Band of ±${format(width, 3)} on average${k < 0 ? "; not measured in these data" : ""}.`, x, y: { label: `dd${coordinate}` }, series, band: true,
    });
    const unconstrained = byId("unconstrained-chart");
    if (data.unconstrained.length === 0) {
      clear(unconstrained);
      unconstrained.append(make("p", { class: "muted", text: "The mass matrix is singular in these data: there is no unconstrained acceleration." }));
      return;
    }
    chart(unconstrained, {
      title: `Unconstrained acceleration ā of ${coordinate}`, summary: `Band of ±${format(2 * rms(data.unconstrained_stddev[j]), 3)} on average. What the constraint hides of ā the data cannot show.`,
      x, y: { label: `ā ${coordinate}`, quantity: `abar_${coordinate}` }, series: [withBand("ā", data.unconstrained[j], data.unconstrained_stddev[j])], band: true,
    });
  }

  // ---- the motion that the fit makes of the measured start -------------------------------------------------------------------

  const timeOf = (motion, t) => format(t, digitsOf(motion.t[0], motion.t[motion.t.length - 1]));

  function rolloutLead(motion) {
    if (motion.reason) return `There is none for the ${data.name} data: ${motion.reason}.`;
    const start = motion.t[0], reached = motion.t[motion.simulated[0].filter((value) => value !== null).length - 1];
    const within = `within its band, or 5 % of the measured range,`, at = (t) => timeOf(motion, t);
    const parts = [motion.leaves === null
      ? `Over the ${format(reached - start, 4)} s ${motion.ended ? "that it reached" : "shown"} the simulated motion stays with the measured one of the ${data.name} data: ${within} to the end.`
      : `The simulated motion stays with the measured one of the ${data.name} data ${within} for ${format(motion.leaves - start, 3)} s; ${model.coordinates[motion.leaving]} leaves first, at t = ${at(motion.leaves)}.`];
    if (motion.far_from !== null) parts.push(`From t = ${at(motion.far_from)} on it is far from the training data.`);
    if (motion.ended) parts.push(`It ended early: ${motion.ended}.`);
    return parts.join(" ");
  }

  function drawRollout() {
    const motion = data.rollout;
    byId("rollout-lead").textContent = rolloutLead(motion);
    byId("rollout-parts").hidden = Boolean(motion.reason);
    drawMechanism(motion);
    const hosts = ["rollout-charts", "rollout-force-charts", "rollout-energy-charts"].map(byId);
    if (motion.reason) {
      for (const host of hosts) keep(host, 0);
      return;
    }
    const x = { label: "t [s]", values: motion.t };
    const measured = (values) => ({ label: "measured", values, colour: "--c2", kind: "points", size: 4 });
    const simulated = (values, std) => ({ label: "simulated", values, colour: "--c1", kind: "line", ...(std ? { low: band(values, std, -1), high: band(values, std, 1) } : {}) });
    keep(hosts[0], model.coordinates.length);
    model.coordinates.forEach((name, j) => chart(hosts[0].children[j], {
      title: name, summary: `${format(apart(motion.measured[j], motion.simulated[j]), 3)} apart (rms), band of ±${format(2 * rms(motion.stddev[j]), 3)} on average`, x, y: { label: name },
      series: [measured(motion.measured[j]), simulated(motion.simulated[j], motion.stddev[j])],
    }));
    byId("rollout-forces").hidden = !motion.multipliers.length;
    keep(hosts[1], motion.multipliers.length);
    motion.multipliers.forEach((name, k) => chart(hosts[1].children[k], {
      title: name, summary: model.constraints[k] ? `of ${model.constraints[k].text} = 0` : "", x, y: { label: name },
      series: [{ label: "at the measured states", values: motion.lambda[k], colour: "--c2", band: "--band2", kind: "line", low: band(motion.lambda[k], motion.lambda_stddev[k], -1), high: band(motion.lambda[k], motion.lambda_stddev[k], 1) },
        { ...simulated(motion.lambda_simulated[k]), dash: [6, 3] }],
    }));
    const energies = motion.energy.length > 0;
    byId("rollout-energies").hidden = !energies;
    keep(hosts[2], energies ? 1 + motion.potentials.length : 0);
    if (!energies) return;
    // over the same time, where the simulated motion ends early
    const both = numbers(motion.t.length).filter((i) => motion.energy[i] !== null && motion.energy_simulated[i] !== null);
    const change = (values) => format(values[both[both.length - 1]] - values[both[0]], 3);
    chart(hosts[2].children[0], {
      title: "Kinetic + potential energy", summary: `changes by ${change(motion.energy)} J as measured, ${change(motion.energy_simulated)} J as simulated${motion.ended ? ", as far as both go" : ""}${motion.potentials.length ? "; learned potentials are among it" : ""}`,
      x, y: { label: "energy [J]" }, series: [measured(motion.energy), simulated(motion.energy_simulated)],
    });
    motion.potentials.forEach((one, k) => chart(hosts[2].children[1 + k], {
      title: `Learned potential ${one.latent}`, summary: "at the measured states, less that at the first", x, y: { label: "V [J]" }, band: true,
      series: [{ label: "V", values: one.mean, colour: "--c1", kind: "line", low: band(one.mean, one.stddev, -1), high: band(one.mean, one.stddev, 1) }],
    }));
  }

  // ---- in space: the mechanism as it moves ------------------------------------------------------------------------------------

  let yaw = -0.7, pitch = 0.42;

  /** By dragging and by the arrow keys. */
  function letTurn(element, draw) {
    const turn = (right, up) => { yaw += right; pitch = Math.max(-1.5, Math.min(1.5, pitch + up)); draw(); };
    element.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.09, 0], ArrowRight: [0.09, 0], ArrowUp: [0, 0.09], ArrowDown: [0, -0.09] }[event.key];
      if (!step) return;
      event.preventDefault();
      turn(...step);
    });
    element.addEventListener("pointerdown", (event) => element.setPointerCapture(event.pointerId));
    element.addEventListener("pointermove", (event) => {
      if (element.hasPointerCapture(event.pointerId)) turn(event.movementX * 0.008, event.movementY * 0.008);
    });
  }

  const svg = (tag, attributes = {}) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };

  function drawMechanism(motion) {
    const host = byId("rollout-mechanism");
    clear(host);
    host.hidden = Boolean(motion.reason) || !motion.measured_points.flat().some((value) => value !== null);
    if (host.hidden) return;
    const dimensions = motion.measured_points.length / motion.points.length;
    const inSpace = dimensions === 3;
    // where a point is in the picture [m], whose y points down
    const place = (rows, k, i) => {
      const at = Array.from({ length: dimensions }, (_, axis) => rows[dimensions * k + axis][i]);
      if (at.includes(null)) return null;
      if (!inSpace) return [at[0], -at[1]];
      const away = Math.sin(yaw) * at[0] + Math.cos(yaw) * at[1];
      return [Math.cos(yaw) * at[0] - Math.sin(yaw) * at[1], -(Math.sin(pitch) * away + Math.cos(pitch) * at[2])];
    };
    const path = (places) => {
      let pen = "M";
      return places.map((at) => { const step = at ? `${pen}${at[0].toPrecision(6)} ${at[1].toPrecision(6)}` : ""; pen = at ? "L" : "M"; return step; }).join("");
    };

    const title = "The mechanism";
    const summary = `${motion.points.join(", ")}${inSpace ? ". Drag, or focus and press the arrow keys, to turn." : ""}`;
    const picture = svg("svg", { class: "mechanism", role: "img", "aria-label": `${title}: ${summary}`, ...(inSpace ? { tabindex: "0" } : {}) });
    const play = make("button", { type: "button", text: "Play" });
    const slider = make("input", { type: "range", min: "0", max: String(motion.t.length - 1), value: "0", step: "1", "aria-label": "time" });
    const clock = make("output");
    const legend = make("ul", { class: "legend" }, ...[["measured", "--c2"], ["simulated", "--c1"]].map(([label, ink]) => make("li", {}, make("span", { class: "swatch line", style: `background:${colour(ink)};border-color:${colour(ink)}` }), label)));
    host.append(make("figure", {}, make("figcaption", {}, make("strong", { text: title }), make("span", { class: "summary", text: summary })), legend, picture, make("div", { class: "controls" }, play, slider, clock)));

    const all = motion.points.map((_, k) => k);
    const traces = all.map(() => svg("path", { class: "trace" }));
    const bodies = ["measured", "simulated"].map((kind) => ({
      rows: motion[`${kind}_points`],
      lines: motion.lines.map(() => svg("path", { class: kind })),
      dots: all.map((k) => {
        const dot = svg("circle", { class: kind });
        const name = svg("title");
        name.textContent = `${motion.points[k]}, ${kind}`;
        dot.append(name);
        return dot;
      }),
    }));
    picture.append(...traces, ...bodies.flatMap(({ lines, dots }) => [...lines, ...dots]));

    function drawAt(i) {
      slider.value = String(i);
      clock.textContent = `t = ${timeOf(motion, motion.t[i])} s`;
      for (const { rows, lines, dots } of bodies) {
        motion.lines.forEach((line, l) => lines[l].setAttribute("d", path(line.map((k) => place(rows, k, i)))));
        dots.forEach((dot, k) => {
          const at = place(rows, k, i);
          dot.style.display = at ? "" : "none";
          if (at) { dot.setAttribute("cx", at[0].toPrecision(6)); dot.setAttribute("cy", at[1].toPrecision(6)); }
        });
      }
    }
    function draw() {
      const paths = all.map((k) => motion.t.map((_, i) => place(motion.measured_points, k, i)));
      all.forEach((k) => traces[k].setAttribute("d", path(paths[k])));
      // as large as what was measured
      const [low, high] = [Math.min, Math.max].map((most) => [0, 1].map((axis) => paths.flat().filter(Boolean).reduce((best, at) => most(best, at[axis]), most === Math.min ? Infinity : -Infinity)));
      const largest = Math.max(high[0] - low[0], high[1] - low[1]) || 1;
      const [width, height] = [0, 1].map((axis) => Math.max(high[axis] - low[axis], 0.3 * largest) + 0.12 * largest);
      picture.setAttribute("viewBox", `${(low[0] + high[0] - width) / 2} ${(low[1] + high[1] - height) / 2} ${width} ${height}`);
      picture.style.aspectRatio = `${width} / ${height}`;
      for (const { dots } of bodies) for (const dot of dots) dot.setAttribute("r", String(0.011 * largest));
      drawAt(Number(slider.value));
    }
    // as fast as it was, but neither too fast nor too slow to watch
    const [start, end] = [motion.t[0], motion.t[motion.t.length - 1]];
    const rate = (end - start) / Math.max(3, Math.min(20, end - start));
    if (rate !== 1) clock.title = `played at ${format(rate, 2)} times its speed`;
    let frame = 0;
    const stop = () => { cancelAnimationFrame(frame); frame = 0; play.textContent = "Play"; };
    play.addEventListener("click", () => {
      if (frame) return stop();
      const from = Number(slider.value) === motion.t.length - 1 ? 0 : Number(slider.value);
      let begun = null;
      play.textContent = "Pause";
      const step = (now) => {
        begun ??= now;
        const t = motion.t[from] + (rate * (now - begun)) / 1000;
        const next = motion.t.findIndex((time) => time > t);
        drawAt(next < 0 ? motion.t.length - 1 : Math.max(next - 1, 0));
        if (next < 0) return stop();
        frame = requestAnimationFrame(step);
      };
      frame = requestAnimationFrame(step);
    });
    slider.addEventListener("input", () => { stop(); drawAt(Number(slider.value)); });
    if (inSpace) letTurn(picture, draw);
    live.set(host, stop);
    draw();
  }

  // ---- where the data are: phase planes, and three coordinates in space ---------------------------------------------------

  function drawSpace(host, names, surface) {
    clear(host);
    const points = data.columns[names[0]].map((_, i) => names.map((name) => data.columns[name][i]));
    const sheets = surface ? surface.sheets : [];
    const range = names.map((name, axis) => {
      const known = data.columns[name].slice();
      if (surface && axis === surface.solved) for (const sheet of sheets) known.push(...sheet.flat().filter((value) => value !== null));
      if (surface && axis !== surface.solved) known.push(...(axis === surface.first ? surface.first_grid : surface.second_grid));
      return [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
    });
    const scaled = (value, axis) => (range[axis][1] > range[axis][0] ? (2 * (value - range[axis][0])) / (range[axis][1] - range[axis][0]) - 1 : 0);
    const summary = `${points.length} states${surface ? " and the surface on which the constraint holds" : ""}. Drag, or focus and press the arrow keys, to turn.`;
    const canvas = make("canvas", { class: "space3d", tabindex: "0", role: "img", "aria-label": `Coordinates ${names.join(", ")} in space. ${summary}` });
    host.append(make("figure", {}, make("figcaption", {}, make("strong", { text: `Coordinates ${names.join(", ")}` }), make("span", { class: "summary", text: summary })), canvas));
    const grid = (sheet, i, j) => {
      if (sheet[i][j] === null) return null;
      const p = [0, 0, 0];
      p[surface.first] = scaled(surface.first_grid[i], surface.first);
      p[surface.second] = scaled(surface.second_grid[j], surface.second);
      p[surface.solved] = scaled(sheet[i][j], surface.solved);
      return p;
    };
    const cells = [];
    for (const sheet of sheets) {
      for (let i = 0; i + 1 < sheet.length; ++i) {
        for (let j = 0; j + 1 < sheet[i].length; ++j) {
          const corners = [grid(sheet, i, j), grid(sheet, i + 1, j), grid(sheet, i + 1, j + 1), grid(sheet, i, j + 1)];
          if (corners.every((corner) => corner !== null)) cells.push(corners);
        }
      }
    }
    const cloud = points.map((p) => p.map(scaled));

    function draw() {
      const scale = devicePixelRatio || 1;
      const width = canvas.clientWidth, height = canvas.clientHeight;
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
      const ctx = canvas.getContext("2d");
      ctx.scale(scale, scale);
      const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
      // as large as fits whatever the turn about the vertical
      const reach = 1.12;  // of the box with perspective
      const size = Math.min((width / 2 - 34) / (Math.SQRT2 * reach), (height / 2 - 30) / ((Math.SQRT2 * Math.abs(sp) + cp) * reach));
      const project = ([x, y, z]) => {
        const right = cy * x - sy * y, away = sy * x + cy * y;
        const depth = cp * away - sp * z;
        const zoom = 1 / (1 + 0.13 * depth);
        return [width / 2 + size * right * zoom, height / 2 - size * (sp * away + cp * z) * zoom, depth];
      };
      // the box; its lowest edges and its leftmost upright one bear the labels
      ctx.font = font;
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      ctx.lineWidth = 1;
      const labelled = [];
      for (let axis = 0; axis < 3; ++axis) {
        const edges = [[-1, -1], [-1, 1], [1, -1], [1, 1]].map(([u, v]) => [-1, 1].map((end) => {
          const p = [0, 0, 0];
          p[axis] = end;
          p[(axis + 1) % 3] = u;
          p[(axis + 2) % 3] = v;
          return project(p);
        }));
        ctx.strokeStyle = colour("--line");
        for (const [from, to] of edges) {
          ctx.beginPath();
          ctx.moveTo(from[0], from[1]);
          ctx.lineTo(to[0], to[1]);
          ctx.stroke();
        }
        const rank = axis === 2 ? ([from, to]) => from[0] + to[0] : ([from, to]) => -(from[1] + to[1]);
        labelled.push(edges.reduce((best, edge) => (rank(edge) < rank(best) ? edge : best)));
      }
      const faces = cells.map((corners) => { const at = corners.map(project); return [at, at.reduce((sum, p) => sum + p[2], 0)]; });
      faces.sort((a, b) => b[1] - a[1]);
      ctx.fillStyle = colour("--mesh");
      ctx.strokeStyle = colour("--mesh-line");
      ctx.lineWidth = 0.6;
      for (const [at] of faces) {
        ctx.beginPath();
        at.forEach((p, i) => (i === 0 ? ctx.moveTo(p[0], p[1]) : ctx.lineTo(p[0], p[1])));
        ctx.closePath();
        ctx.fill();
        ctx.stroke();
      }
      ctx.fillStyle = colour("--c1");
      ctx.strokeStyle = colour("--c1");
      const shown = cloud.map(project);
      if (along().ordered) {
        ctx.globalAlpha = 0.6;
        ctx.beginPath();
        shown.forEach((p, i) => (i === 0 ? ctx.moveTo(p[0], p[1]) : ctx.lineTo(p[0], p[1])));
        ctx.stroke();
      }
      for (const p of shown) {
        ctx.globalAlpha = 0.85 - 0.3 * Math.max(-1, Math.min(1, p[2]));
        ctx.beginPath();
        ctx.arc(p[0], p[1], shown.length > 400 ? 2 : 3, 0, 2 * Math.PI);
        ctx.fill();
      }
      ctx.globalAlpha = 1;
      labelled.forEach(([from, to], axis) => {
        const middle = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
        // outwards, square to the edge
        let out = [to[1] - from[1], from[0] - to[0]];
        const long = Math.hypot(...out) || 1;
        const side = out[0] * (middle[0] - width / 2) + out[1] * (middle[1] - height / 2) < 0 ? -1 : 1;
        out = out.map((part) => (side * part) / long);
        ctx.strokeStyle = colour("--muted");
        ctx.beginPath();
        ctx.moveTo(from[0], from[1]);
        ctx.lineTo(to[0], to[1]);
        ctx.stroke();
        ctx.fillStyle = colour("--text");
        ctx.fillText(names[axis], middle[0] + 20 * out[0], middle[1] + 16 * out[1]);
        ctx.fillStyle = colour("--muted");
        for (const [share, value] of [[0.06, range[axis][0]], [0.94, range[axis][1]]]) {
          ctx.fillText(format(value, 3), from[0] + share * (to[0] - from[0]) + 20 * out[0], from[1] + share * (to[1] - from[1]) + 14 * out[1]);
        }
      });
    }
    letTurn(canvas, draw);
    const watch = new ResizeObserver(draw);
    watch.observe(canvas);
    live.set(host, () => watch.disconnect());
    draw();
  }

  function motionViews() {
    const known = model.coordinates.filter((name) => data.columns[name]);
    const views = [];
    for (let first = 0; first + 2 < known.length && first < 4; ++first) {
      const names = known.slice(first, first + 3);
      views.push([`space ${first}`, `${names.join(", ")} in space`, names]);
    }
    for (const name of model.coordinates) {
      if (data.columns[name] && data.columns[`d${name}`]) views.push([`phase ${name}`, `phase plane ${name}, d${name}`, [name, `d${name}`]]);
    }
    if (known.length === 2) views.push(["plane", `${known[0]}, ${known[1]}`, known]);
    // coordinates that the model does not read: velocities against each other
    const rates = model.coordinates.map((name) => `d${name}`).filter((name) => data.columns[name]);
    if (!views.length) for (let k = 1; k < rates.length; ++k) views.push([`rates ${k}`, `${rates[0]}, ${rates[k]}`, [rates[0], rates[k]]]);
    return views;
  }

  function drawMotion() {
    const host = byId("motion-chart");
    const view = motionViews().find(([value]) => value === byId("motion-view").value);
    if (!view) return note(host, "The data hold no coordinate with its velocity.");
    const names = view[2];
    if (names.length === 3) {
      return drawSpace(host, names, data.other_system ? null : report.surface);
    }
    const ordered = along().ordered;
    chart(host, {
      title: `${names[0]}, ${names[1]}`, summary: `${data.n} states of the ${data.name} data${ordered ? ", one after another in time" : ""}.`, height: 360, trace: ordered,
      x: { label: names[0], values: data.columns[names[0]] }, y: { label: names[1] }, series: [{ label: names[1], values: data.columns[names[1]], colour: "--c1", kind: "points" }],
    });
  }

  function fillRelevance() {
    const host = byId("relevance-bars");
    if (!report.relevance.length) return note(host, "The kernels have no lengthscales.");
    const largest = Math.max(...report.relevance.map((one) => one.relevance || 0)) || 1;
    const several = new Set(report.relevance.map((one) => one.latent)).size > 1;
    const rows = [...report.relevance].sort((a, b) => (a.latent === b.latent ? b.relevance - a.relevance : 0));
    const bar = (one) => make("span", { class: "track" }, make("span", { class: "fill", style: `width:${(100 * one.relevance) / largest}%` }));
    const built = table("Relevance of the features", [{ label: "feature" }, { label: "relevance" }, { label: "", number: true }, { label: "effect", number: true }, { label: "lengthscale", number: true }, { label: "spread", number: true }],
      rows.map((one) => [several ? `${one.feature} (${one.latent})` : one.feature, bar(one), one.relevance, one.effect, one.lengthscale, one.spread].map((value) => (typeof value === "number" ? make("span", { text: format(value, 3), title: String(value), "data-value": String(value) }) : value))));
    built.querySelector("table").classList.add("bars");
    for (const row of built.querySelectorAll("tbody tr")) row.children[1].classList.add("bar");
    host.append(built);
  }

  // ---- several fits side by side ------------------------------------------------------------------------------------------

  /** The data on which fits are compared: the test, else what they were trained on. */
  const judged = (one) => one.data.find((data) => data.test) || one.data[0];

  /** The label of a fit, short where its folder is that of all. */
  function labels() {
    const names = reports.map((one) => one.label.replace(/^.*\//, ""));
    return reports.map((one, k) => {
      const name = new Set(names).size === names.length ? names[k] : one.label;
      const before = reports.slice(0, k).filter((other) => other.label === one.label).length;
      return before ? `${name} (${before + 1})` : name;
    });
  }

  /** Why no fit can be said to be the better one; empty where all are scored on the same test. */
  function whyNotComparable() {
    const systems = new Set(reports.map((one) => one.model.coordinates.join(", ")));
    if (systems.size > 1) return `The fits are of different systems, with the coordinates ${[...systems].join(" and ")}: their figures do not compare.`;
    const tests = reports.map(judged).map((one) => (one && one.test ? [one.source, one.n, one.outputs, one.figures.n].join() : ""));
    if (tests.some((one) => one === "" || one !== tests[0])) return "The fits are not scored on the same test data: which one is better these figures do not tell.";
    return "";
  }

  function compareScores(names) {
    const all = (get) => reports.map((one) => get(one));
    const figure = (get) => all((one) => { const data = judged(one); return data ? get(data.figures) : null; });
    const outputs = [...new Set(reports.flatMap((one) => (judged(one) ? judged(one).outputs : [])))];
    const rmse = (output) => figure((e) => { const k = e.outputs.indexOf(output); return k < 0 ? null : e.rmse[k]; });
    const low = (values) => values.map((value) => value);
    const rows = [
      ["rows learned from", all((one) => one.observations.reduce((sum, group) => sum + group.n, 0))],
      ["optimiser", all((one) => (one.fit.converged ? "converged" : one.fit.iterations === 0 ? "did not run" : "not converged"))],
      ["negative log likelihood", all((one) => one.fit.nll)],
      ...outputs.map((output) => [`rmse ${output}`, rmse(output), low]),
      ["nrmse", figure((e) => e.nrmse), low],
      ["nlpd, with noise", figure((e) => e.nlpd), low],
      ["95 % coverage, with noise", figure((e) => e.coverage95), (values) => values.map((value) => Math.abs(value - 0.95))],
      ["nlpd, without noise", figure((e) => e.nlpd_latent)],
      ["95 % coverage, without noise", figure((e) => e.coverage95_latent)],
      ["points far from the data", figure((e) => e.n_far)],
      ["max |A q̈ − b|, fitted", figure((e) => e.max_constraint_error_fitted)],
    ];
    // not the time within the band: a fit that knows little has a wide one
    const why = whyNotComparable();
    const motions = all((one) => judged(one)?.rollout).map((motion) => (motion && !motion.reason && !(why && motion.ended) ? motion : null));
    // of one test over the time that all of them reached
    const reached = Math.min(...motions.map((motion) => (motion && !why ? motion.simulated[0].filter((value) => value !== null).length : Infinity)));
    const off = motions.map((motion) => motion && rms(motion.measured.map((values, j) => apart(values.slice(0, reached), motion.simulated[j]) / (Math.max(...values) - Math.min(...values) || 1))));
    const early = motions.find((motion) => motion && reached < motion.t.length);
    if (off.some((value) => value !== null)) rows.push([`simulated motion, rms error / range${early ? `, until t = ${timeOf(early, early.t[reached - 1])} s` : ""}`, off, low]);
    const built = table("Scores of the fits", [{ label: "" }, ...names.map((label) => ({ label, number: true }))], rows.map(([label, values]) => [label, ...values]));
    // the best of a row, where one is better than the others
    if (!why) rows.forEach(([, values, cost], r) => {
      if (!cost || values.some((value) => value === null)) return;
      const costs = cost(values), least = Math.min(...costs);
      if (costs.filter((one) => one === least).length > 1) return;
      built.querySelectorAll("tbody tr")[r].children[1 + costs.indexOf(least)].classList.add("best");
    });
    byId("comparison-scores").append(built);
    const data = [...new Set(reports.map((one) => { const used = judged(one); return used ? `${used.name}: ${used.source}` : "none"; }))];
    byId("comparison-scores").append(make("p", { class: "muted", text: `Scored on – ${data.join("; ")}. ${why || "The better of a row is green and bold; “without noise” is right only for targets without noise, and not marked."} Likelihoods, those at the fit, compare where the rows learned from are the same.` }));
  }

  function compareParameters(names) {
    const estimated = [...new Set(reports.flatMap((one) => one.parameters.filter((row) => row.fitted !== undefined).map((row) => row.name)))];
    const host = byId("comparison-parameters");
    if (!estimated.length) {
      host.previousElementSibling.remove();
      host.remove();
      return;
    }
    const columns = [{ label: "parameter" }, ...names.flatMap((name) => [{ label: name, number: true }, { label: "standard error", number: true }])];
    host.append(table("Estimated parameters of the fits", columns, estimated.map((name) => [withUnit(name), ...reports.flatMap((one) => {
      const row = one.parameters.find((candidate) => candidate.name === name);
      if (!row) return [null, null];
      return row.fitted === undefined ? [row.model, "held"] : [row.fitted, row.stddev];
    })])));
  }

  const palette = [["--c1", "--band"], ["--c2", "--band2"], ["--c3", "--band3"], ["--c4", "--band4"]];

  function drawComparison(names) {
    const chosen = byId("comparison-force").value;
    const curves = reports.map((one) => one.learned.filter((curve) => curve.name === chosen));
    const span = (along) => Math.max(...curves.flat().filter((curve) => curve.along === along).map(reach));
    const alongs = [...new Set(curves.flat().map((curve) => curve.along))].sort((a, b) => span(b) - span(a));
    const range = curves.flat().flatMap((one) => [...band(one.mean, one.stddev, -1), ...band(one.mean, one.stddev, 1)]);
    const y = { label: chosen.split("@")[0], range: padded(Math.min(...range), Math.max(...range), 0.08) };
    const host = keep(byId("comparison-charts"), alongs.length);
    alongs.forEach((along, k) => {
      const shown = curves.map((of) => of.find((curve) => curve.along === along));
      // each fit has values of its own along the axis
      const x = [...new Set(shown.flatMap((curve) => (curve ? curve.at : [])))].sort((a, b) => a - b);
      const series = shown.flatMap((curve, i) => {
        if (!curve) return [];
        const placed = (values) => { const at = new Map(curve.at.map((value, p) => [value, values[p]])); return x.map((value) => at.get(value) ?? null); };
        const [ink, fill] = palette[i % palette.length];
        return [{ label: names[i], values: placed(curve.mean), colour: ink, band: fill, kind: "line", spanned: true, low: placed(band(curve.mean, curve.stddev, -1)), high: placed(band(curve.mean, curve.stddev, 1)) }];
      });
      chart(host.children[k], { title: `${chosen} along ${along}`, summary: `Learned by ${series.map((one) => one.label).join(" and ")}.`, x: { label: along, quantity: along, values: x }, y, series, band: true });
    });
  }

  /** The page of another fit, below the comparison. */
  function show(next) {
    for (const host of [...live.keys()].filter((one) => !byId("comparison").contains(one))) clear(host);
    redrawn = [];
    for (const id of ["tiles", "sections"]) byId(id).replaceChildren();
    for (const part of [...byId("content").children].filter((one) => one.id !== "comparison")) part.remove();
    byId("content").append(...blank.map((part) => part.cloneNode(true)));
    report = next;
    ({ fit, model } = report);
    test = report.data.find((one) => one.test);
    data = test || report.data[0];
    byId("title").textContent = model.name;
    start();
  }
  const blank = [...byId("content").children].filter((one) => one.id !== "comparison").map((part) => part.cloneNode(true));

  function fillComparison() {
    const names = labels();
    compareScores(names);
    compareParameters(names);
    const forces = [...new Set(reports.flatMap((one) => one.learned.map((curve) => curve.name)))];
    if (forces.length) {
      options(byId("comparison-force"), forces.map((name) => [name, name]));
      const draw = () => drawComparison(names);
      byId("comparison-force").addEventListener("change", draw);
      lasting.push(draw);
      draw();
    } else byId("comparison-learned").remove();
    reports.forEach((one, k) => {
      const input = make("input", { type: "radio", name: "fit", value: String(k), id: `fit-${k}` });
      input.checked = k === 0;
      input.addEventListener("change", () => show(one));
      byId("fit-choice").append(make("label", { for: `fit-${k}` }, input, names[k]));
    });
  }

  // ---- controls -----------------------------------------------------------------------------------------------------------

  function drawAll() {
    drawResiduals();
    drawScatter();
    drawCalibration();
    drawConstraint();
    drawAccelerations();
    drawRollout();
    drawMotion();
  }

  function fillControls() {
    const feature = byId("residual-feature");
    options(feature, [...data.features.filter((name) => data.columns[name]).map((name) => [name, name]), ["", along().label === "row" ? "row of the log" : "time"]], feature.options.length ? feature.value : data.features[0]);
    const against = byId("scatter-against");
    options(against, data.truth ? [["measured", "measured"], ["truth", "true"]] : [["measured", "measured"]], against.value);
    byId("scatter-controls").hidden = !data.truth;
    const calibration = byId("calibration-output");
    options(calibration, [[String(data.outputs.length), "all outputs"], ...data.outputs.map((name, k) => [String(k), name])], calibration.value);
    const acceleration = byId("acceleration-output");
    options(acceleration, model.coordinates.map((name, j) => [String(j), name]), acceleration.value);
    const motion = byId("motion-view");
    options(motion, motionViews().map(([value, label]) => [value, label]), motion.value);
    byId("motion-controls").hidden = motion.options.length < 2;
  }

  function start() {
    if (!data) {
      for (const part of document.querySelectorAll("#data-choice, #pictures section:not(#relevance)")) part.remove();
      byId("pictures").append(make("p", { class: "muted", text: "No pictures: the fit learned from no acceleration, and no test data were given." }));
    }
    if (!report.learned.length) byId("learned").remove();
    fillHeader();
    fillAdvice();
    fillModel();
    fillOptimiser();
    fillFigures();
    fillLearned();
    fillRelevance();
    if (!data) return;
    const choice = byId("data-choice");
    report.data.forEach((one, k) => {
      const input = make("input", { type: "radio", name: "data", value: String(k), id: `data-${k}` });
      input.checked = one === data;
      input.addEventListener("change", () => { data = one; fillControls(); drawAll(); });
      choice.append(make("label", { for: `data-${k}` }, input, `${one.name} (${one.n}${one.stride > 1 ? `, one in ${one.stride} drawn` : ""})`));
    });
    fillControls();
    for (const [id, draw] of [["residual-feature", drawResiduals], ["scatter-against", drawScatter], ["calibration-output", drawCalibration], ["acceleration-output", drawAccelerations], ["motion-view", drawMotion]]) {
      byId(id).addEventListener("change", draw);
    }
    drawAll();
    redrawn.push(drawAll);
  }

  if (reports.length > 1) fillComparison();
  else byId("comparison").remove();
  start();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { for (const draw of [...lasting, ...redrawn]) draw(); });
})();
