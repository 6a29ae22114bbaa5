// The page of gp2 report, seen with a headless Chromium. Run by run-page-test, which sets GP2_COMMAND and CHROMIUM.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { after, before, test } from "node:test";
import { fileURLToPath, pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const models = join(dirname(fileURLToPath(import.meta.url)), "../../models");
const folder = mkdtempSync(join(tmpdir(), "gp2_report_"));
const gp2 = (...args) => execFileSync(process.env.GP2_COMMAND, args, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
const json = (name) => JSON.parse(readFileSync(join(folder, name), "utf8"));

// what a person who wishes ill could call a model
const hostile = `</script><img src=x onerror="document.title='broken'"><!-- {{data}} "quoted" & \\u003c`;

/** A page whose data are changed. */
function rewrite(from, to, change) {
  const html = readFileSync(join(folder, from), "utf8");
  const place = html.indexOf('id="report">') + 'id="report">'.length, end = html.indexOf("</script>", place);
  const reports = JSON.parse(html.slice(place, end));
  change(reports);
  writeFileSync(join(folder, to), html.slice(0, place) + JSON.stringify(reports).replaceAll("<", "\\u003c") + html.slice(end));
}

let browser;

before(async () => {
  for (const model of ["surface", "duffing", "unicycle"]) {
    const file = join(models, `${model}.toml`);
    gp2("generate", file, "--n", "100", "--seed", "1", "-o", `${model}.csv`);
    gp2("generate", file, "--n", "60", "--seed", "2", "-o", `${model}_test.csv`);
    gp2("fit", file, "--data", `${model}.csv`, "--mean", "force", "--restarts", "3", "-o", `${model}.json`);
    gp2("report", `${model}.json`, "--data", `${model}_test.csv`, "--truth", file, "-o", `${model}.html`);
  }
  writeFileSync(join(folder, "hostile.toml"),
    readFileSync(join(models, "unicycle.toml"), "utf8").replace(/^name .*$/m, () => `name = ${JSON.stringify(hostile)}`));
  gp2("fit", "hostile.toml", "--data", "unicycle.csv", "--max-iterations", "0", "-o", "hostile.json");
  gp2("report", "hostile.json", "-o", "hostile.html");
  const args = process.getuid?.() === 0 ? ["--no-sandbox"] : [];
  browser = await chromium.launch({ executablePath: process.env.CHROMIUM, args });
});

after(async () => {
  await browser?.close();
  rmSync(folder, { recursive: true, force: true });
});

/** An open page; close() fails where the page complained or asked for anything beside its own file. */
async function open(name, { width = 1200, scheme = "light", pictures = true } = {}) {
  const page = await browser.newPage({ viewport: { width, height: 900 }, colorScheme: scheme });
  const complaints = [], requests = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("dialog", (dialog) => { complaints.push(`dialog ${dialog.message()}`); dialog.dismiss(); });
  const own = pathToFileURL(join(folder, name)).href;
  page.on("request", (request) => { if (request.url().split("#")[0] !== own && !request.url().startsWith("data:")) requests.push(request.url()); });
  await page.goto(own, { timeout: 120_000 });  // a busy machine is slow to start
  if (pictures) await page.waitForFunction(() => document.querySelectorAll("canvas").length > 0);
  await settled(page);
  return {
    page,
    async close() {
      await page.close();
      assert.deepEqual(complaints, [], "complaints in the console");
      assert.deepEqual(requests, [], "requests");
    },
  };
}

// charts are drawn in a microtask, and again when their size is known
const settled = (page) => page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 50)))));

/** Per canvas: its title, and how many pixels have the colour of the data. */
const inked = (page) => page.evaluate(() => {
  const [r, g, b] = getComputedStyle(document.documentElement).getPropertyValue("--c1").trim().match(/[0-9a-f]{2}/gi).map((part) => parseInt(part, 16));
  return [...document.querySelectorAll("canvas")].map((canvas) => {
    // of a copy: reading the page's own canvas would slow it down, and it would complain
    const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] > 80 && Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 60) ++count;
    }
    return { title: canvas.closest("figure").querySelector("strong").textContent, count };
  });
});

/** The exact numbers of a table, by the header of their row. */
const numbers = (page, host) => page.evaluate((id) => Object.fromEntries([...document.querySelectorAll(`#${id} tbody tr`)].map((row) =>
  [row.children[0].textContent.trim(), [...row.querySelectorAll("[data-value]")].map((cell) => Number(cell.dataset.value))])), host);

for (const model of ["surface", "duffing", "unicycle"]) {
  test(`every chart of ${model} shows data, in a light and a dark theme and after every choice`, async () => {
    for (const scheme of ["light", "dark"]) {
      const { page, close } = await open(`${model}.html`, { scheme });
      const outputs = json(`${model}.json`).observations[0].rows.length;
      const charts = await inked(page);
      const learned = await page.evaluate(() => JSON.parse(document.getElementById("report").textContent)[0].learned);
      const shown = learned.filter((one) => one.name === learned[0].name);
      assert.equal(charts.length, 2 * outputs + 6 + shown.length, "residuals and scatter per output, calibration, PIT, constraint error, two accelerations, motion, learned forces");
      assert.deepEqual(new Set(await page.locator("#learned-force option").evaluateAll((all) => all.map((one) => one.value))), new Set(learned.map((one) => one.name)));
      for (const { title, count } of charts) assert.ok(count > 20, `${title}: ${count} pixels in ${scheme}`);
      for (const select of scheme === "dark" ? [] : await page.locator("select:visible").all()) {
        for (const value of await select.locator("option").evaluateAll((all) => all.map((one) => one.value))) {
          await select.selectOption(value);
          await settled(page);
          for (const { title, count } of await inked(page)) assert.ok(count > 20, `${title}: ${count} pixels`);
        }
      }
      await page.getByLabel(/^training/).check();
      await settled(page);
      for (const { title, count } of await inked(page)) assert.ok(count > 20, `${title} of training: ${count} pixels`);
      await close();
    }
  });

  test(`the tables of ${model} carry the numbers of the fit and of gp2 evaluate`, async () => {
    const { page, close } = await open(`${model}.html`);
    const fit = json(`${model}.json`);
    const hyperparameters = await numbers(page, "hyperparameters");
    assert.equal(Object.keys(hyperparameters).length, fit.hyperparameters.length);
    for (const one of fit.hyperparameters) assert.deepEqual(hyperparameters[one.name], [one.value, one.lower, one.upper], one.name);
    const restarts = await numbers(page, "restarts");
    const best = (k) => (k === fit.report.best_restart ? `${k + 1} best` : String(k + 1));
    assert.deepEqual(fit.report.restarts.map((_, k) => restarts[best(k)]), fit.report.restarts.map((one) => [one.objective, one.nll, one.iterations, one.evaluations, one.failed_evaluations]));
    const lead = await page.locator("#optimiser-lead").textContent();
    assert.ok(lead.toLowerCase().includes(fit.report.termination.toLowerCase()), lead);
    assert.ok(lead.includes(String(Number(fit.report.nll.toPrecision(6)))), lead);

    const figures = await numbers(page, "figures");
    const told = ["", "_test"].map((suffix) => JSON.parse(gp2("evaluate", `${model}.json`, "--data", `${model}${suffix}.csv`, "--json")));
    const row = (get) => told.map(get);
    const near = (actual, expected, name) => {
      assert.equal(actual.length, expected.length, name);
      actual.forEach((value, k) => assert.ok(Math.abs(value - expected[k]) <= 1e-9 * Math.abs(expected[k]), `${name}: ${value}, ${expected[k]}`));
    };
    const units = await page.evaluate(() => JSON.parse(document.getElementById("report").textContent)[0].model.units);
    for (const output of Object.keys(told[0].rmse)) near(figures[`rmse ${output}${output in units ? ` [${units[output]}]` : ""}`], row((e) => e.rmse[output]), output);
    near(figures["rmse / training std"], row((e) => e.rmse_normalised), "rmse_normalised");
    near(figures["nrmse"], row((e) => e.nrmse), "nrmse");
    near(figures["nlpd, with noise"], row((e) => e.nlpd), "nlpd");
    for (const share of [50, 80, 95]) near(figures[`${share} % coverage, with noise`], row((e) => e[`coverage${share}`]), `coverage${share}`);
    assert.deepEqual(figures["max |A q̈ − b|, fitted"], row((e) => e.max_constraint_error_fitted));
    assert.deepEqual(figures.points, [100, 60]);
    await close();
  });
}

test("two fits stand side by side, and each has the page below", async () => {
  const file = join(models, "surface.toml");
  gp2("fit", file, "--data", "surface.csv", "--restarts", "1", "-o", "plain.json");
  gp2("report", "surface.json", "plain.json", "--data", "surface_test.csv", "-o", "both.html");
  const told = ["surface", "plain"].map((name) => JSON.parse(gp2("evaluate", `${name}.json`, "--data", "surface_test.csv", "--json")));
  for (const [scheme, width] of [["light", 1200], ["dark", 360]]) {
    const { page, close } = await open("both.html", { scheme, width });
    const scores = await numbers(page, "comparison-scores");
    assert.deepEqual(scores["negative log likelihood"], ["surface", "plain"].map((name) => json(`${name}.json`).report.nll));
    for (const [row, key] of [["nrmse", "nrmse"], ["nlpd, with noise", "nlpd"], ["95 % coverage, with noise", "coverage95"]]) {
      scores[row].forEach((value, k) => assert.ok(Math.abs(value - told[k][key]) <= 1e-9 * Math.abs(value), row));
    }
    const best = await page.locator("#comparison-scores tr", { hasText: "nrmse" }).locator(".best").getAttribute("data-value");
    assert.equal(Number(best), Math.min(...scores.nrmse));
    assert.equal(await page.locator("#comparison-scores tr", { hasText: "without noise" }).locator(".best").count(), 0);
    assert.ok((await page.locator("#comparison-charts canvas").count()) > 0);
    assert.equal(await page.locator("#comparison-parameters").count(), 0, "no parameter was estimated");
    assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), width);
    // the page of the other fit, and back
    for (const [label, name] of [["plain.json", "plain"], ["surface.json", "surface"]]) {
      await page.getByLabel(label, { exact: true }).check();
      await settled(page);
      const hyperparameters = await numbers(page, "hyperparameters");
      for (const one of json(`${name}.json`).hyperparameters) assert.deepEqual(hyperparameters[one.name], [one.value, one.lower, one.upper], one.name);
      assert.equal(await page.locator("#tiles div").count(), 5);
      assert.equal(await page.locator("main section").count(), await page.locator("#sections li").count());
      const charts = (await inked(page)).filter(({ title }) => !title.startsWith("force_"));
      for (const { title, count } of charts) assert.ok(count > 20, `${title}: ${count} pixels of ${label}`);
      await page.emulateMedia({ colorScheme: scheme === "light" ? "dark" : "light" });
      await settled(page);
      await page.emulateMedia({ colorScheme: scheme });
    }
    await close();
  }
});

test("fits that were not scored on the same test are not told apart", async () => {
  for (const [fits, why] of [[["surface", "surface"], "not scored on the same test data"], [["surface", "duffing"], "of different systems"]]) {
    gp2("report", ...fits.map((name) => `${name}.json`), "-o", "apart.html");
    const { page, close } = await open("apart.html");
    assert.equal(await page.locator("#comparison-scores .best").count(), 0);
    assert.ok((await page.locator("#comparison-scores p").textContent()).includes(why), why);
    await close();
  }
});

test("a measured motion stands beside the simulated one, with its forces and energy", async () => {
  const file = join(models, "surface.toml");
  gp2("simulate", file, "--start", "q1=0.4,q2=0.8,dq1=0.8,dq2=1", "--t-end", "6", "--dt", "0.05", "-o", "motion.csv");
  gp2("simulate", "surface.json", "--start", "motion.csv", "--t-end", "6", "--dt", "0.05", "-o", "simulated.csv");
  gp2("report", "surface.json", "--data", "motion.csv", "-o", "motion.html");
  const lines = readFileSync(join(folder, "simulated.csv"), "utf8").trim().split("\n").map((line) => line.split(","));
  const column = (name) => lines.slice(1).map((line) => Number(line[lines[0].indexOf(name)]));
  for (const [scheme, width] of [["light", 1200], ["dark", 360]]) {
    const { page, close } = await open("motion.html", { scheme, width });
    const motion = await page.evaluate(() => JSON.parse(document.getElementById("report").textContent)[0].data[1].rollout);
    for (const [told, name] of [[motion.simulated[0], "q1"], [motion.simulated[2], "q3"], [motion.lambda_simulated[0], "lambda1"], [motion.energy_simulated, "energy"]]) {
      column(name).forEach((value, i) => assert.ok(Math.abs(value - told[i]) <= 1e-5 * Math.max(1, Math.abs(value)), `${name} ${i}`));
    }
    const lead = await page.locator("#rollout-lead").textContent();
    assert.ok(motion.leaves === null ? lead.includes("to the end") : lead.includes(`at t = ${Number(motion.leaves.toPrecision(4))}.`), lead);
    const shown = new Set(await page.locator("#rollout figcaption strong").allTextContents());
    assert.deepEqual(shown, new Set(["The mechanism", "q1", "q2", "q3", "lambda1", "Kinetic + potential energy"]));
    for (const { title, count } of (await inked(page)).filter((one) => shown.has(one.title))) assert.ok(count > 20, `${title}: ${count} pixels in ${scheme}`);
    assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), width);
    // the training data have no time
    await page.getByLabel(/^training/).check();
    await settled(page);
    assert.equal(await page.locator("#rollout canvas").count(), 0);
    assert.match(await page.locator("#rollout-lead").textContent(), /^There is none for the training data: the data lack t, which the model does not read/);
    await close();
  }
});

test("the mechanism moves, its points where the model has them", async () => {
  const file = join(models, "../examples/crank.toml"), log = join(models, "../examples/crank_log.csv");
  gp2("derive", log, "--model", file, "-o", "crank.csv");
  gp2("fit", file, "--data", "crank.csv", "--observe", "ddphi", "--mean", "force", "--max-points", "50", "--restarts", "1", "-o", "crank.json");
  gp2("report", "crank.json", "--data", "crank.csv", "-o", "crank.html");
  for (const [scheme, width] of [["light", 1200], ["dark", 360]]) {
    const { page, close } = await open("crank.html", { scheme, width });
    const motion = await page.evaluate(() => JSON.parse(document.getElementById("report").textContent)[0].data[1].rollout);
    assert.deepEqual(motion.points, ["axle", "pin", "slide"]);
    const slider = page.locator(".mechanism + .controls input"), clock = page.locator(".mechanism + .controls output");
    for (const i of [0, Math.floor(motion.t.length / 2)]) {
      await slider.fill(String(i));
      assert.equal(await clock.textContent(), `t = ${Number(motion.t[i].toPrecision(4))} s`);
      const [axle, pin, slide] = (await page.locator(".mechanism path.measured").getAttribute("d")).split(/[ML]/).slice(1).map((point) => point.split(" ").map(Number));
      // one scale along both axes, y up: the crank's r = 0.06, the rod's l = 0.18
      const scale = Math.hypot(pin[0] - axle[0], pin[1] - axle[1]) / 0.06;
      const at = [pin[0] - axle[0], axle[1] - pin[1], slide[0] - axle[0], slide[1] - axle[1]];
      const told = [motion.measured_points[2][i], motion.measured_points[3][i], motion.measured_points[4][i], 0];
      at.forEach((value, k) => assert.ok(Math.abs(value - scale * told[k]) < 1e-3, `${value} beside ${scale * told[k]}`));
      assert.ok(Math.abs(told[0] - 0.06 * Math.cos(motion.measured[0][i])) < 1e-6);
    }
    await page.getByRole("button", { name: "Play" }).click();
    await page.waitForFunction((before) => document.querySelector(".mechanism + .controls output").textContent !== before, await clock.textContent());
    await page.getByRole("button", { name: "Pause" }).click();
    assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), width);
    await close();
  }
});

test("fits side by side are told apart by how far their motions are off", async () => {
  const file = join(models, "surface.toml");
  const run = (of, out) => gp2("simulate", of, "--start", "q1=0.4,q2=0.8,dq1=0.8,dq2=1", "--t-end", "2", "--dt", "0.05", "-o", out);
  gp2("fit", file, "--data", "surface.csv", "--max-points", "5", "--restarts", "1", "-o", "few.json");
  run(file, "truth.csv");
  gp2("report", "few.json", "surface.json", "--data", "truth.csv", "-o", "off.html");
  const column = (csv, name) => {
    const lines = readFileSync(join(folder, csv), "utf8").trim().split("\n").map((line) => line.split(","));
    return lines.slice(1).map((line) => Number(line[lines[0].indexOf(name)]));
  };
  const expected = ["few", "surface"].map((name) => {
    run(`${name}.json`, "own.csv");
    const shares = ["q1", "q2", "q3"].map((q) => {
      const [measured, own] = [column("truth.csv", q), column("own.csv", q)];
      const squares = measured.map((value, i) => (value - own[i]) ** 2);
      return squares.reduce((a, b) => a + b) / squares.length / (Math.max(...measured) - Math.min(...measured)) ** 2;
    });
    return Math.sqrt(shares.reduce((a, b) => a + b) / 3);
  });
  const { page, close } = await open("off.html");
  const off = (await numbers(page, "comparison-scores"))["simulated motion, rms error / range"];
  off.forEach((value, k) => assert.ok(Math.abs(value - expected[k]) <= 1e-3 * expected[k], `${off}, ${expected}`));
  assert.ok(off[1] < off[0], String(off));
  await close();
});

/** The last simulated values of a motion are gone, as where its simulation ended early. */
function endAt(motion, n) {
  motion.ended = "there is no more";
  for (const values of [...motion.simulated, ...motion.stddev, motion.energy_simulated]) values.fill(null, n);
}

test("a motion that ends early is compared over the time that both go", async () => {
  const file = join(models, "surface.toml"), n = 21;
  gp2("simulate", file, "--start", "q1=0.4,q2=0.8,dq1=0.8,dq2=1", "--t-end", "2", "--dt", "0.05", "-o", "short.csv");
  gp2("report", "surface.json", "--data", "short.csv", "-o", "whole.html");
  gp2("report", "surface.json", "surface.json", "--data", "short.csv", "-o", "twice.html");
  let motion;
  rewrite("whole.html", "early.html", ([{ data: [, data] }]) => { motion = data.rollout; endAt(motion, n); });
  rewrite("twice.html", "twice_early.html", ([, { data: [, data] }]) => endAt(data.rollout, n));
  const one = await open("early.html");
  const caption = await one.page.locator("#rollout-energy-charts .summary").first().textContent();
  const [measured, simulated] = [...caption.matchAll(/ ([-\d.e]+) J as/g)].map((found) => Number(found[1]));
  for (const [told, values] of [[measured, motion.energy], [simulated, motion.energy_simulated]]) {
    const change = values[n - 1] - values[0];
    assert.ok(Math.abs(told - change) <= 1e-2 * Math.abs(change) + 1e-9, caption);
  }
  await one.close();
  const { page, close } = await open("twice_early.html");
  const scores = await numbers(page, "comparison-scores");
  const off = scores["simulated motion, rms error / range, until t = 1 s"];
  assert.equal(off.length, 2, Object.keys(scores).join("; "));
  assert.equal(off[0], off[1]);
  await close();
});

test("the likelihood of the fit is not that of rows that came later, and a constraint says when it holds", async () => {
  rewrite("surface.html", "changed.html", ([report]) => {
    report.fit.rows_are_those_of_fit = false;
    Object.assign(report.model.constraints[0], { when: "q1 < 2", contact: true });
  });
  const { page, close } = await open("changed.html");
  assert.match(await page.locator("#tiles").textContent(), /at the last fit or shoot; rows may have changed since/);
  assert.match(await page.locator("#constraints table").textContent(), /holds.*a contact, while q1 < 2/);
  await close();
  const plain = await open("surface.html");
  assert.match(await plain.page.locator("#tiles").textContent(), /of 100 rows/);
  assert.doesNotMatch(await plain.page.locator("#constraints table").textContent(), /holds/);
  await plain.close();
});

test("axes have ticks for a range of rounding errors, and for times since 1970", async () => {
  rewrite("surface.html", "narrow.html", ([{ data: [, data] }]) => {
    data.columns.t = data.predicted[0].map((_, i) => 1.7e9 + i);
    data.predicted[0] = data.predicted[0].map(() => 100);
    data.stddev[0] = data.stddev[0].map(() => 1e-14);
  });
  const { page, close } = await open("narrow.html");
  for (const { title, count } of await inked(page)) assert.ok(count > 20, `${title}: ${count} pixels`);
  await page.locator("#constrained-chart .u-over").hover();
  assert.match(await page.locator("#constrained-chart .readout").textContent(), /^t \[s\] 17000000\d\d /);
  await close();
});

test("the derived constraint is typeset", async () => {
  const { page, close } = await open("surface.html");
  const formulas = await page.locator(".formula math").evaluateAll((all) => all.map((one) => [one.namespaceURI, one.textContent, one.getBoundingClientRect().height]));
  assert.equal(formulas.length, 2);
  for (const [namespace, text, height] of formulas) {
    assert.equal(namespace, "http://www.w3.org/1998/Math/MathML");
    assert.match(text, /^[Ab]=/);
    assert.ok(height > 10);
  }
  await close();
});

test("Tab reaches every control and shows where it is", async () => {
  const { page, close } = await open("surface.html", { width: 360 });
  // of a group of radio buttons one is a stop, the checked one
  const expected = await page.evaluate(() => [...document.querySelectorAll("a[href], button, input, select, summary, [tabindex='0']")]
    .filter((one) => one.offsetParent !== null || one.classList.contains("skip"))
    .filter((one) => one.type !== "radio" || one.checked)
    .map((one, k) => { one.dataset.stop = String(k); return String(k); }));
  const reached = new Set();
  for (let k = 0; k < expected.length + 5; ++k) {
    await page.keyboard.press("Tab");
    const [stop, outline] = await page.evaluate(() => [document.activeElement.dataset.stop, getComputedStyle(document.activeElement).outlineStyle]);
    if (stop === undefined) continue;
    reached.add(stop);
    assert.notEqual(outline, "none", `stop ${stop} shows no focus`);
  }
  assert.deepEqual(expected.filter((stop) => !reached.has(stop)), []);
  await close();
});

test("the arrow keys and the mouse turn the picture in space", async () => {
  const { page, close } = await open("surface.html");
  const canvas = page.locator("canvas.space3d");
  const picture = () => canvas.evaluate((one) => one.toDataURL());
  const first = await picture();
  await canvas.focus();
  await page.keyboard.press("ArrowRight");
  const second = await picture();
  assert.notEqual(first, second);
  await canvas.scrollIntoViewIfNeeded();
  const box = await canvas.boundingBox();
  await page.mouse.move(box.x + 100, box.y + 100);
  await page.mouse.down();
  await page.mouse.move(box.x + 180, box.y + 120, { steps: 4 });
  await page.mouse.up();
  assert.notEqual(second, await picture());
  await close();
});

for (const model of ["surface", "duffing", "unicycle"]) {
  test(`${model} fits a phone: nothing reaches beyond 360 pixels`, async () => {
    const { page, close } = await open(`${model}.html`, { width: 360 });
    assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), 360);
    await close();
  });
}

test("the theme follows the system, also while the page is open", async () => {
  const { page, close } = await open("surface.html");
  const background = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor.match(/\d+/g).slice(0, 3).map(Number));
  const light = await background();
  assert.ok(light.every((part) => part > 200), String(light));
  await page.emulateMedia({ colorScheme: "dark" });
  await settled(page);
  const dark = await background();
  assert.ok(dark.every((part) => part < 60), String(dark));
  for (const { title, count } of await inked(page)) assert.ok(count > 20, `${title}: ${count} pixels in the dark`);
  await close();
});

test("pictures and tables have names for those who do not see them", async () => {
  const { page, close } = await open("surface.html");
  const nameless = await page.evaluate(() => [...document.querySelectorAll("[role=img], table, nav, [role=region]")]
    .filter((one) => !(one.getAttribute("aria-label") || "").trim()).length +
    [...document.querySelectorAll("select")].filter((one) => one.labels.length === 0).length);
  assert.equal(nameless, 0);
  assert.deepEqual(await page.locator("h1").count(), 1);
  await close();
});

test("the name of a model stays text", async () => {
  const { page, close } = await open("hostile.html");
  assert.equal(await page.locator("h1").textContent(), hostile);
  assert.equal(await page.title(), `${hostile} – gp2 report`);
  assert.equal(await page.locator("img").count(), 0);
  await close();
});

test("a fit to 1000 rows with 1000 rows of test makes at most 2 MB", async () => {
  const file = join(models, "surface.toml");
  gp2("generate", file, "--n", "1000", "--seed", "3", "-o", "large.csv");
  gp2("generate", file, "--n", "1000", "--seed", "4", "-o", "large_test.csv");
  gp2("fit", file, "--data", "large.csv", "--max-iterations", "0", "-o", "large.json");
  gp2("report", "large.json", "--data", "large_test.csv", "--truth", file, "-o", "large.html");
  const { size } = statSync(join(folder, "large.html"));
  assert.ok(size <= 2e6, `${size} bytes`);
  const { page, close } = await open("large.html");
  for (const { title, count } of await inked(page)) assert.ok(count > 20, `${title}: ${count} pixels`);
  await close();
});

test("a fit that learned from no acceleration has a page without pictures", async () => {
  // the same numbers, said to be of the unconstrained acceleration
  const fit = json("unicycle.json");
  // of a format without a checksum
  fit.version = 5;
  delete fit.checksum;
  const [group] = fit.observations;
  group.view = "unconstrained";
  for (const name of ["q1", "q2", "q3"]) {
    group.values[`abar_${name}`] = group.values[`dd${name}`];
    delete group.values[`dd${name}`];
  }
  writeFileSync(join(folder, "no_pictures.json"), JSON.stringify(fit));
  gp2("report", "no_pictures.json", "-o", "no_pictures.html");
  const { page, close } = await open("no_pictures.html", { pictures: false });
  assert.equal(await page.locator("#pictures canvas").count(), 0);
  assert.ok(await page.getByText("No pictures").isVisible());
  assert.ok((await page.locator("#relevance-bars tbody tr").count()) > 0);
  for (const target of await page.locator("nav a").evaluateAll((all) => all.map((one) => one.getAttribute("href")))) {
    assert.equal(await page.locator(target).count(), 1, target);
  }
  await close();
});
