// The bars over time: reward, descriptor, feet.
"use strict";

(function () {
  const HEIGHT = { line: 56, feet: 12 };

  NQD.Player.prototype.drawCharts = function () {
    const data = this.data, w = this.selected;
    for (const old of this.charts.querySelectorAll(".chart")) old.remove();
    const length = data.lengths[w];
    const total = Math.max(1, Math.max(...data.lengths));
    const steps = data.rewards.shape[1];
    const every = data.feet_most || 1; // a frame has the sum of several steps
    const reward = [];
    for (let k = 0; k < length; k++) {
      const within = data.steps ? Math.min(every, data.steps[w] - k * every) : every;
      reward.push(data.rewards.data[w * steps + k] / within);
    }
    this.chart("reward of a step", [reward], 1, total, ["reward"]);
    const nf = data.feet.shape[2];
    if (nf) this.feetChart(w, nf, length, total);
    const nd = data.descriptors.shape[2];
    const isFeet = nf === nd && data.descriptor_names.every((n) => n.endsWith("contact"));
    if (nd && !isFeet) {
      const lines = [];
      for (let c = 0; c < nd; c++) {
        const line = [];
        for (let k = 0; k <= length; k++) {
          line.push(data.descriptors.data[(w * (steps + 1) + k) * nd + c]);
        }
        lines.push(line);
      }
      this.chart("state descriptor", lines, 0, total, data.descriptor_names);
    }
  };

  function surface(charts, title, height, hint) {
    const row = NQD.element("div", charts, { name: "chart" });
    const names = NQD.element("div", row, { name: "names" });
    NQD.element("span", names, { text: title, name: "title", title: hint });
    const canvas = NQD.element("canvas", row, { role: "img", label: "chart of " + title });
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(50, charts.clientWidth);
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    canvas.style.height = height + "px";
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    return { pen: pen, names: names, width: width };
  }

  function key(names, text, color) {
    const made = NQD.element("span", names, { name: "key isolate", text: text });
    made.style.color = color;
  }

  function short(value) {
    return Number.isFinite(value) ? String(Number(value.toPrecision(3))) : "-";
  }

  NQD.short = short;

  NQD.Player.prototype.chart = function (title, lines, first, total, names) {
    const made = surface(this.charts, title, HEIGHT.line,
      "Lowest and highest value are beside the title");
    let low = Infinity, high = -Infinity;
    for (const line of lines) {
      for (const value of line) {
        if (!Number.isFinite(value)) continue;
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
    if (!(high > low)) { low -= 0.5; high = low + 1; }
    NQD.element("span", made.names, {
      name: "range", text: short(low) + " \u2026 " + short(high),
    });
    lines.forEach((line, index) => {
      const color = NQD.palette[index % NQD.palette.length];
      if (lines.length > 1) key(made.names, names[index], color);
      made.pen.strokeStyle = color;
      made.pen.lineWidth = 1.5;
      made.pen.beginPath();
      line.forEach((value, k) => {
        const x = (k + first) / total * made.width;
        const y = HEIGHT.line - 3 - (value - low) / (high - low) * (HEIGHT.line - 6);
        if (k) made.pen.lineTo(x, y);
        else made.pen.moveTo(x, y);
      });
      made.pen.stroke();
    });
  };

  NQD.Player.prototype.feetChart = function (w, nf, length, total) {
    const made = surface(this.charts, "feet on the ground", HEIGHT.feet * nf,
      "A bar: the foot touches the ground. A pale bar: for a part of the frame. "
      + "Beside the name: share of the steps");
    const names = this.view.drawing.feet;
    const frames = this.data.feet.shape[1], most = this.data.feet_most || 1;
    const steps = this.data.steps ? this.data.steps[w] : length;
    for (let f = 0; f < nf; f++) {
      const color = NQD.palette[f % NQD.palette.length];
      let touched = 0;
      made.pen.fillStyle = color;
      for (let k = 0; k < length; k++) { // as a descriptor: not the last state
        // a frame may stand for several steps
        const seen = this.data.feet.data[(w * frames + k) * nf + f];
        if (!seen) continue;
        touched += seen;
        const share = seen / Math.min(most, steps - k * most);
        made.pen.globalAlpha = share;
        const x = k / total * made.width;
        made.pen.fillRect(
          x, f * HEIGHT.feet + 1, Math.max(1, made.width / total), HEIGHT.feet - 2);
      }
      made.pen.globalAlpha = 1;
      key(made.names, names[f] + " " + Math.round(100 * touched / Math.max(1, steps))
        + " %", color);
    }
  };
})();
