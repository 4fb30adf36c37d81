// The explorer page: maps of one or two archives, and the elites of the chosen cells.
"use strict";

(function () {
  // Ends of many numbers: a function does not take all of them as arguments.
  const least = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);
  const most = (values) => values.reduce((a, b) => Math.max(a, b), -Infinity);

  const data = NQD.data();
  const section = document.getElementById("maps");
  document.getElementById("title").textContent = data.title;

  const runs = data.runs.map((run) => {
    for (const name of ["cells", "descriptors", "moving"]) run[name] = NQD.decode(run[name]);
    for (const name of ["q", "rewards", "feet"]) {
      run.motion[name] = NQD.decode(run.motion[name]);
    }
    for (const metric of run.metrics) metric.values = NQD.decode(metric.values);
    for (const name of Object.keys(run.curves)) run.curves[name] = NQD.decode(run.curves[name]);
    for (const name of ["indices", "centroids"]) {
      if (run.map[name]) run.map[name] = NQD.decode(run.map[name]);
    }
    run.row = new Int32Array(run.cells.data.length).fill(-1); // of the motion
    run.moving.data.forEach((elite, row) => { run.row[elite] = row; });
    return run;
  });

  const player = new NQD.Player(
    document.getElementById("player"), data.drawing, runs.length, {
      unit: data.unit,
      key: (key) => {
        if (!key.startsWith("Arrow")) return false;
        maps[active].walk(key);
        return true;
      },
    });
  let active = 0;

  // Bar: colour and filter.
  const bar = NQD.element("div", section, { name: "bar" });
  const label = NQD.element("label", bar, { text: "colour " });
  const choice = NQD.element("select", label);
  // archives of other descriptors have other metrics: a colour needs one of both
  const metric = (run, name) => run.metrics.find((each) => each.name === name);
  for (const { name } of runs[0].metrics) {
    if (!runs.every((run) => metric(run, name))) continue;
    NQD.element("option", choice, { text: name }).value = name;
  }
  const limit = NQD.element("label", bar, { text: "fitness from " });
  const filter = NQD.element("input", limit, { type: "range" });
  const shown = NQD.element("span", limit, { name: "clock" });
  const fitness = runs.map((run) => run.metrics[0].values.data);
  const lowest = least(fitness.map(least));
  const highest = most(fitness.map(most));
  filter.step = "any";
  filter.min = String(lowest);
  filter.max = String(highest);
  filter.value = String(lowest);
  const start = filter.value; // the browser rounds it, perhaps above the lowest

  const maps = runs.map((run, index) => {
    const part = NQD.element("div", section, { name: "run" });
    const heading = NQD.element("h2", part, { text: run.name, name: "isolate" });
    if (runs.length > 1) { // the colour of its robot
      heading.style.borderLeft = "12px solid " + NQD.palette[index];
      heading.style.paddingLeft = "6px";
    }
    NQD.element("div", part, { text: run.facts, name: "soft isolate" });
    NQD.element("div", part, {
      text: "Click a " + (run.map.grid || run.low.length <= 2 ? "cell" : "line")
        + ", or press an arrow key: this elite then moves.",
      name: "soft",
    });
    const map = new NQD.Map(part, run, (elite) => choose(index, elite));
    if (run.notice) NQD.element("div", part, { text: run.notice, name: "notice" });
    const tools = NQD.element("div", part, { name: "tools" });
    const save = NQD.element("button", tools, { text: "genotype", type: "button" });
    save.title = "Download the genotype of the chosen elite";
    save.addEventListener("click", () => download(run, map.selected));
    map.code = NQD.element("code", tools, { name: "isolate" });
    map.canvas.addEventListener("pointerdown", () => { active = index; });
    map.canvas.addEventListener("focus", () => { active = index; });
    return map;
  });
  const scale = NQD.element("div", section, { name: "scale" });
  const curves = NQD.element("div", section, { name: "curves" });

  function download(run, elite) {
    let content = { run: run.name, cell: run.cells.data[elite] };
    if (run.genotypes) {
      const values = run.decoded || (run.decoded = NQD.decode(run.genotypes));
      const size = values.shape[1];
      content.genotype = Array.from(
        values.data.subarray(elite * size, (elite + 1) * size));
    } else {
      content.python = maps[runs.indexOf(run)].code.textContent;
    }
    const link = document.createElement("a");
    link.href = URL.createObjectURL(
      new Blob([JSON.stringify(content)], { type: "application/json" }));
    link.download = "cell-" + content.cell + ".json";
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // Colours every map with one scale, so that two archives can be compared.
  function colour() {
    const name = choice.value;
    let low = Infinity, high = -Infinity;
    for (const run of runs) {
      for (const value of metric(run, name).values.data) {
        if (!Number.isFinite(value)) continue;
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
    const from = filter.value === start ? lowest : Math.min(Number(filter.value), highest);
    maps.forEach((map, r) => {
      fitness[r].forEach((value, e) => { map.shown[e] = value >= from ? 1 : 0; });
      map.colour(metric(runs[r], name).values.data, low, high);
    });
    shown.textContent = NQD.short(from);
    scale.replaceChildren();
    NQD.element("span", scale, { text: NQD.short(low) });
    const strip = NQD.element("span", scale, { name: "strip" });
    const steps = [];
    for (let k = 0; k <= 10; k++) steps.push(NQD.viridis(k / 10));
    strip.style.background = "linear-gradient(to right, " + steps.join(",") + ")";
    NQD.element("span", scale, { text: NQD.short(high) });
    NQD.element("span", scale, { text: name, name: "soft isolate" });
  }
  choice.addEventListener("change", colour);
  filter.addEventListener("input", colour);

  const chosen = runs.map(() => 0);

  function choose(index, elite) {
    active = index;
    chosen[index] = elite;
    const cell = runs[index].cells.data[elite];
    maps[index].code.textContent =
      "load_run(" + JSON.stringify(runs[index].name) + ").elite(" + cell + ").genotype";
    player.selected = index;
    load();
  }

  // Gives the chosen elites to the player.
  function load() {
    const first = runs[0].motion.q.shape;
    const frames = Math.max(...runs.map((run) => run.motion.q.shape[1]));
    const nq = first[2], nf = runs[0].motion.feet.shape[2], count = runs.length;
    const shown = {
      dt: data.dt,
      q: { shape: [count, frames, nq], data: new Float32Array(count * frames * nq) },
      rewards: { shape: [count, frames - 1], data: new Float32Array(count * (frames - 1)) },
      descriptors: { shape: [count, frames, 0], data: new Float32Array(0) },
      descriptor_names: [],
      feet: { shape: [count, frames, nf], data: new Uint8Array(count * frames * nf) },
      feet_most: runs[0].motion.every,
      lengths: [],
      steps: [],
    };
    runs.forEach((run, r) => {
      const motion = run.motion, own = motion.q.shape[1];
      const row = run.row[chosen[r]];
      shown.lengths.push(row < 0 ? 0 : motion.lengths[row]);
      shown.steps.push(row < 0 ? 0 : motion.steps[row]);
      const at = Math.max(row, 0);
      shown.q.data.set(
        motion.q.data.subarray(at * own * nq, (at + 1) * own * nq), r * frames * nq);
      shown.rewards.data.set(
        motion.rewards.data.subarray(at * (own - 1), (at + 1) * (own - 1)),
        r * (frames - 1));
      shown.feet.data.set(
        motion.feet.data.subarray(at * (own - 1) * nf, (at + 1) * (own - 1) * nf),
        r * frames * nf);
    });
    player.load(shown);
    player.playing = true;
    const map = maps[active], run = runs[active], elite = chosen[active];
    const facts = document.getElementById("facts");
    facts.textContent = (runs.length > 1 ? run.name + ", " : "") + "cell "
      + run.cells.data[elite] + ", fitness " + NQD.short(fitness[active][elite])
      + (run.row[elite] < 0 ? ", which is not recorded" : "");
    map.describe(elite);
  }

  // Small pictures of the columns of metrics.csv.
  function drawCurves() {
    curves.replaceChildren();
    const end = most(runs.map((run) => most(run.curves.evaluations.data)));
    for (const name of Object.keys(runs[0].curves)) {
      if (name === "evaluations") continue;
      const part = NQD.element("div", curves, { name: "curve" });
      NQD.element("div", part, { text: name.replaceAll("_", " "), name: "soft" });
      const canvas = NQD.element("canvas", part, {
        role: "img", label: "curve of " + name.replaceAll("_", " "),
      });
      const wide = canvas.width = Math.max(60, part.clientWidth), tall = canvas.height = 70;
      const pen = canvas.getContext("2d");
      const all = runs.flatMap((run) => Array.from(run.curves[name].data))
        .filter(Number.isFinite);
      const low = least(all), high = most(all);
      runs.forEach((run, r) => {
        pen.strokeStyle = NQD.palette[r];
        pen.lineWidth = 1.5;
        pen.beginPath();
        run.curves[name].data.forEach((value, k) => {
          const x = run.curves.evaluations.data[k] / end * (wide - 2) + 1;
          const y = tall - 3 - (value - low) / (high - low || 1) * (tall - 6);
          if (k) pen.lineTo(x, y);
          else pen.moveTo(x, y);
        });
        pen.stroke();
      });
      NQD.element("div", part, {
        text: NQD.short(low) + " \u2026 " + NQD.short(high)
          + (name === "coverage" ? " %" : ""), name: "soft",
      });
    }
    NQD.element("div", curves, {
      text: "curves over 0 \u2026 " + end + " evaluations", name: "wide soft",
    });
    for (const run of runs) {
      for (const line of run.reevaluated || []) {
        NQD.element("div", curves, {
          text: (runs.length > 1 ? run.name + ": " : "") + line, name: "wide isolate",
        });
      }
    }
  }

  const best = fitness.map((values) => values.indexOf(most(values)));
  NQD.theme(player, { theme: () => { maps.forEach((map) => map.draw()); } });
  maps.forEach((map, r) => {
    map.selected = chosen[r] = best[r];
  });
  colour();
  drawCurves();
  maps.forEach((map, r) => map.pick(best[r]));
  active = 0;
  player.selected = 0;
  load();
  player.apply();
  player.start();
  new ResizeObserver(() => {
    maps.forEach((map) => map.draw());
    drawCurves();
  }).observe(section);
  NQD.player = player;
  NQD.maps = maps;
})();
