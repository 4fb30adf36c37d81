// The map of an archive: nested grid, tessellation, or parallel coordinates.
//
// A map knows the owner of every pixel, so that drawing and finding a cell agree.
"use strict";

(function () {
  const MARGIN = { left: 62, right: 14, top: 12, bottom: 44 };
  const EMPTY = -1;

  // The colour map viridis (matplotlib, CC0), as polynomials of the value from 0 to 1.
  const VIRIDIS = [
    [0.2777, 0.0054, 0.3341], [0.1051, 1.4046, 1.3846], [-0.3309, 0.2148, 0.0951],
    [-4.6342, -5.7991, -19.3324], [6.2283, 14.1799, 56.6906],
    [4.7764, -13.7451, -65.3530], [-5.4355, 4.6459, 26.3124],
  ];

  function viridis(x, out, at) {
    for (let c = 0; c < 3; c++) {
      let value = 0;
      for (let p = 6; p >= 0; p--) value = value * x + VIRIDIS[p][c];
      out[at + c] = Math.max(0, Math.min(255, 255 * value));
    }
    out[at + 3] = 255;
  }

  NQD.viridis = function (x) {
    const out = [0, 0, 0, 0];
    viridis(x, out, 0);
    return "rgb(" + out.slice(0, 3).map(Math.round).join(",") + ")";
  };

  // Makes a map of a run inside an element. `picked` is called with an elite's number.
  NQD.Map = function (container, run, picked) {
    this.run = run;
    this.picked = picked;
    this.count = run.cells.data.length;
    this.selected = 0;
    this.hovered = EMPTY;
    this.shown = new Uint8Array(this.count).fill(1); // passes the filter
    this.canvas = NQD.element("canvas", container, {
      name: "map", role: "application", // a screen reader leaves the arrow keys to it
      label: "archive of " + run.name + ", arrow keys choose an elite",
    });
    this.canvas.tabIndex = 0;
    this.pen = this.canvas.getContext("2d");
    this.tip = NQD.element("div", container, { name: "tip", role: "status" });
    this.kind = run.map.grid ? "grid" : run.low.length <= 2 ? "cells" : "lines";
    this.place();
    this.canvas.addEventListener("pointermove", (event) => this.hover(event));
    this.canvas.addEventListener("pointerleave", () => {
      this.hovered = EMPTY;
      this.draw();
      this.describe(this.selected);
    });
    this.canvas.addEventListener("click", (event) => {
      const found = this.find(event);
      if (found !== EMPTY) this.pick(found);
    });
  };

  const Map = NQD.Map.prototype;

  // Finds the place of each elite on the map, from 0 to 1 along both axes.
  Map.place = function () {
    const run = this.run, n = this.count;
    this.u = new Float64Array(n);
    this.v = new Float64Array(n);
    if (this.kind === "grid") {
      const grid = run.map.grid, d = grid.length;
      const nest = (cell, first) => {
        let at = 0, size = 1;
        for (let k = first; k < d; k += 2) {
          at = at * grid[k] + run.map.indices.data[cell * d + k];
          size *= grid[k];
        }
        return { at: at, size: size };
      };
      this.owner = new Map2(nest(0, 0).size, nest(0, 1).size);
      for (let e = 0; e < n; e++) {
        const x = nest(run.cells.data[e], 0), y = nest(run.cells.data[e], 1);
        this.owner.set(x.at, y.at, e);
        this.u[e] = (x.at + 0.5) / x.size;
        this.v[e] = (y.at + 0.5) / y.size;
      }
    } else if (this.kind === "cells") {
      const d = run.low.length, c = run.map.centroids.data;
      const total = c.length / d;
      // a finer map of many cells would keep the page waiting
      const fine = Math.min(360, Math.floor(Math.sqrt(2e8 / total)));
      const side = d === 1 ? 1 : fine;
      this.owner = new Map2(fine, side);
      const of = new Int32Array(total).fill(EMPTY);
      run.cells.data.forEach((cell, e) => { of[cell] = e; });
      const share = (cell, k) =>
        (c[cell * d + k] - run.low[k]) / (run.high[k] - run.low[k]);
      const px = new Float64Array(total), py = new Float64Array(total).fill(0.5);
      for (let i = 0; i < total; i++) {
        px[i] = share(i, 0);
        if (d > 1) py[i] = share(i, 1);
      }
      // nearest in the units of the descriptor, as the archive has it
      const wide = run.high[0] - run.low[0], high = d > 1 ? run.high[1] - run.low[1] : 0;
      for (let y = 0; y < side; y++) {
        for (let x = 0; x < fine; x++) {
          let best = Infinity, at = 0;
          for (let i = 0; i < total; i++) {
            const dx = (px[i] - (x + 0.5) / fine) * wide;
            const dy = (py[i] - (y + 0.5) / side) * high;
            const away = dx * dx + dy * dy;
            if (away < best) { best = away; at = i; }
          }
          this.owner.set(x, y, of[at]);
          this.owner.cell[y * fine + x] = at;
        }
      }
      run.cells.data.forEach((cell, e) => { this.u[e] = px[cell]; this.v[e] = py[cell]; });
    } else {
      run.cells.data.forEach((cell, e) => {
        this.u[e] = 0.5;
        this.v[e] = this.share(e, 0);
      });
    }
  };

  // A table of the owners of places.
  function Map2(width, height) {
    this.width = width;
    this.height = height;
    this.data = new Int32Array(width * height).fill(EMPTY);
    this.cell = new Int32Array(width * height).fill(EMPTY);
  }
  Map2.prototype.set = function (x, y, elite) { this.data[y * this.width + x] = elite; };

  // Component k of an elite's descriptor, as a share of its limits.
  Map.share = function (elite, k) {
    const d = this.run.low.length;
    const value = this.run.descriptors.data[elite * d + k];
    const share = (value - this.run.low[k]) / (this.run.high[k] - this.run.low[k]);
    return Math.min(1, Math.max(0, share));
  };

  // Colours elites by values, between two ends.
  Map.colour = function (values, low, high) {
    this.values = values;
    this.low = low;
    this.high = high;
    this.draw();
  };

  Map.tint = function (elite, out, at) {
    const value = this.values[elite];
    if (!this.shown[elite] || !Number.isFinite(value)) {
      out[at] = out[at + 1] = out[at + 2] = this.shown[elite] ? 150 : 0;
      out[at + 3] = this.shown[elite] ? 255 : 40;
      return;
    }
    const span = this.high - this.low;
    viridis(span > 0 ? (value - this.low) / span : 0.5, out, at);
  };

  Map.resize = function () {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.wide = Math.max(200, this.canvas.clientWidth);
    const flat = this.owner && this.owner.height === 1;
    this.tall = flat ? 130 : Math.round(Math.min(this.wide, 460));
    this.canvas.style.height = this.tall + "px";
    this.canvas.width = this.wide * ratio;
    this.canvas.height = this.tall * ratio;
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.box = {
      x: MARGIN.left, y: MARGIN.top, w: this.wide - MARGIN.left - MARGIN.right,
      h: this.tall - MARGIN.top - MARGIN.bottom,
    };
  };

  Map.draw = function () {
    if (!this.values || !this.canvas.clientWidth) return;
    if (!this.box || this.canvas.clientWidth !== this.wide) this.resize();
    const pen = this.pen;
    pen.clearRect(0, 0, this.wide, this.tall);
    const style = getComputedStyle(this.canvas);
    this.ink = style.getPropertyValue("--ink") || "#000";
    this.soft = style.getPropertyValue("--line") || "#ccc";
    if (this.kind === "lines") this.drawLines();
    else this.drawCells();
    this.drawAxes();
  };

  Map.drawCells = function () {
    const o = this.owner, b = this.box, pen = this.pen;
    const image = new ImageData(o.width, o.height);
    for (let y = 0; y < o.height; y++) {
      for (let x = 0; x < o.width; x++) {
        const elite = o.data[y * o.width + x];
        const at = 4 * ((o.height - 1 - y) * o.width + x);
        if (elite !== EMPTY) this.tint(elite, image.data, at);
      }
    }
    const sheet = document.createElement("canvas");
    sheet.width = o.width;
    sheet.height = o.height;
    sheet.getContext("2d").putImageData(image, 0, 0);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(sheet, b.x, b.y, b.w, b.h);
    pen.strokeStyle = this.soft;
    pen.lineWidth = 1;
    pen.strokeRect(b.x, b.y, b.w, b.h);
    if (this.kind === "grid") this.drawBlocks();
    else this.drawEdges();
    if (this.hovered !== EMPTY) this.outline(this.hovered, 1.5);
    this.outline(this.selected, 3);
  };

  // Lines between the blocks of a nested grid.
  Map.drawBlocks = function () {
    const grid = this.run.map.grid, b = this.box, pen = this.pen;
    pen.strokeStyle = this.ink;
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (let k = 1; grid.length > 2 && k < grid[0]; k++) {
      pen.moveTo(b.x + b.w * k / grid[0], b.y);
      pen.lineTo(b.x + b.w * k / grid[0], b.y + b.h);
    }
    for (let k = 1; grid.length > 3 && k < grid[1]; k++) {
      pen.moveTo(b.x, b.y + b.h * k / grid[1]);
      pen.lineTo(b.x + b.w, b.y + b.h * k / grid[1]);
    }
    pen.stroke();
  };

  // Lines between the cells of a tessellation, as thin rectangles.
  Map.drawEdges = function () {
    const o = this.owner, b = this.box, pen = this.pen;
    const w = b.w / o.width, h = b.h / o.height;
    pen.fillStyle = this.soft;
    for (let y = 0; y < o.height; y++) {
      for (let x = 1; x < o.width; x++) {
        const i = y * o.width + x;
        const up = y ? i - o.width : i;
        if (o.cell[i] === o.cell[i - 1] && o.cell[i] === o.cell[up]) continue;
        pen.fillRect(b.x + x * w, b.y + b.h - (y + 1) * h, w, h);
      }
    }
  };

  Map.outline = function (elite, width) {
    const o = this.owner, b = this.box, pen = this.pen;
    const w = b.w / o.width, h = b.h / o.height;
    const mine = (x, y) => x >= 0 && y >= 0 && x < o.width && y < o.height
      && o.data[y * o.width + x] === elite;
    pen.beginPath();
    for (let y = 0; y < o.height; y++) {
      for (let x = 0; x < o.width; x++) {
        if (!mine(x, y)) continue;
        const left = b.x + x * w, top = b.y + b.h - (y + 1) * h;
        if (!mine(x - 1, y)) { pen.moveTo(left, top); pen.lineTo(left, top + h); }
        if (!mine(x + 1, y)) { pen.moveTo(left + w, top); pen.lineTo(left + w, top + h); }
        if (!mine(x, y + 1)) { pen.moveTo(left, top); pen.lineTo(left + w, top); }
        if (!mine(x, y - 1)) { pen.moveTo(left, top + h); pen.lineTo(left + w, top + h); }
      }
    }
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = width + 2;
    pen.stroke();
    pen.strokeStyle = "#d1242f";
    pen.lineWidth = width;
    pen.stroke();
  };

  // Parallel coordinates: a line for each elite, over one axis for each component.
  Map.drawLines = function () {
    const d = this.run.low.length, b = this.box, pen = this.pen, color = [0, 0, 0, 0];
    const line = (elite) => {
      pen.beginPath();
      for (let k = 0; k < d; k++) {
        const x = b.x + b.w * k / (d - 1), y = b.y + b.h * (1 - this.share(elite, k));
        if (k) pen.lineTo(x, y);
        else pen.moveTo(x, y);
      }
      pen.stroke();
    };
    pen.lineWidth = 1;
    for (let e = 0; e < this.count; e++) {
      this.tint(e, color, 0);
      pen.strokeStyle = "rgba(" + color.slice(0, 3).map(Math.round).join(",") + ","
        + (this.shown[e] ? 0.6 : 0.05) + ")";
      line(e);
    }
    for (const [elite, width] of [[this.hovered, 2], [this.selected, 3.5]]) {
      if (elite === EMPTY) continue;
      pen.strokeStyle = "#d1242f";
      pen.lineWidth = width;
      line(elite);
    }
  };

  Map.drawAxes = function () {
    const run = this.run, b = this.box, pen = this.pen, d = run.low.length;
    pen.fillStyle = pen.strokeStyle = this.ink;
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const tick = (k, share) => NQD.short(run.low[k] + share * (run.high[k] - run.low[k]));
    if (this.kind === "lines") {
      for (let k = 0; k < d; k++) {
        const x = b.x + b.w * k / (d - 1);
        pen.strokeStyle = this.ink;
        pen.lineWidth = 1;
        pen.strokeRect(x, b.y, 0, b.h);
        pen.textAlign = k ? k === d - 1 ? "right" : "center" : "left";
        pen.fillText(run.labels[k], x, b.y + b.h + 30);
        pen.fillText(tick(k, 0), x, b.y + b.h + 12);
        pen.fillText(tick(k, 1), x, 6);
      }
      return;
    }
    const grid = run.map.grid;
    const marks = (k) => grid ? Math.min(grid[k], 8) : 4;
    for (let i = 0; i <= marks(0); i++) {
      pen.textAlign = i === marks(0) ? "right" : "center";
      pen.fillText(tick(0, i / marks(0)), b.x + b.w * i / marks(0), b.y + b.h + 10);
    }
    const inner = (k) => k < d ? ", inside each block " + run.labels[k] : "";
    pen.textAlign = "center";
    pen.fillText(run.labels[0] + inner(2), b.x + b.w / 2, b.y + b.h + 30, b.w);
    if (d < 2) return;
    pen.textAlign = "right";
    for (let i = 0; i <= marks(1); i++) {
      pen.fillText(tick(1, i / marks(1)), b.x - 6, b.y + b.h * (1 - i / marks(1)));
    }
    pen.save();
    pen.translate(12, b.y + b.h / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(run.labels[1] + inner(3), 0, 0, b.h);
    pen.restore();
  };

  // Number of the elite under the pointer.
  Map.find = function (event) {
    const box = this.canvas.getBoundingClientRect(), b = this.box;
    const x = event.clientX - box.left - b.x, y = event.clientY - box.top - b.y;
    if (x < 0 || y < 0 || x >= b.w || y >= b.h) return EMPTY;
    if (this.kind === "lines") return this.nearestLine(x / b.w, 1 - y / b.h);
    const o = this.owner;
    const row = Math.floor((1 - y / b.h) * o.height);
    const elite = o.data[Math.min(row, o.height - 1) * o.width
      + Math.floor(x / b.w * o.width)];
    return elite !== EMPTY && this.shown[elite] ? elite : EMPTY;
  };

  Map.nearestLine = function (x, y) {
    const d = this.run.low.length, at = x * (d - 1);
    const k = Math.min(Math.floor(at), d - 2), share = at - k;
    let best = 0.03, found = EMPTY;
    for (let e = 0; e < this.count; e++) {
      if (!this.shown[e]) continue;
      const height = (1 - share) * this.share(e, k) + share * this.share(e, k + 1);
      if (Math.abs(height - y) < best) {
        best = Math.abs(height - y);
        found = e;
      }
    }
    return found;
  };

  Map.hover = function (event) {
    const found = this.find(event);
    this.canvas.style.cursor = found === EMPTY ? "default" : "pointer";
    if (found === this.hovered) return;
    this.hovered = found;
    this.draw();
    this.describe(found === EMPTY ? this.selected : found);
  };

  // Writes the values of an elite below the map.
  Map.describe = function (elite) {
    const run = this.run;
    const parts = ["cell " + run.cells.data[elite]];
    for (const metric of run.metrics) {
      parts.push(metric.name + " " + NQD.short(metric.values.data[elite]));
    }
    this.tip.textContent = parts.join(" \u00b7 ");
  };

  Map.pick = function (elite) {
    this.selected = elite;
    this.draw();
    this.describe(elite);
    this.picked(elite);
  };

  // Goes to the nearest elite in a direction.
  Map.walk = function (key) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1],
      ArrowDown: [0, -1] }[key];
    let best = Infinity, found = EMPTY;
    const from = this.selected;
    for (let e = 0; e < this.count; e++) {
      if (e === from || !this.shown[e]) continue;
      const dx = this.u[e] - this.u[from], dy = this.v[e] - this.v[from];
      const ahead = dx * step[0] + dy * step[1];
      const aside = Math.abs(dx * step[1] - dy * step[0]);
      if (ahead <= 1e-9 || aside > ahead) continue;
      if (ahead + 2 * aside < best) {
        best = ahead + 2 * aside;
        found = e;
      }
    }
    if (found !== EMPTY) this.pick(found);
  };
})();
