// Plays a trajectory: time, controls, keyboard, and the bars below the view.
"use strict";

(function () {
  const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
  const ARROW = 0.6; // length of a strong impulse's arrow [radii of the robot]
  const LONGEST = 2; // impulse of the longest arrow [strong impulses]

  // Makes a player inside an element. `options.keys` is whether it listens to keys.
  NQD.Player = function (container, drawing, worlds, options) {
    const player = this;
    player.options = options || {};
    player.time = 0;
    player.speed = 1;
    player.playing = true;
    player.follow = drawing.follow;
    player.selected = 0;
    player.showTrail = true;
    player.build(container, drawing, worlds);
    player.view = new NQD.View(player.stage, drawing, worlds);
    player.listen();
  };

  const Player = NQD.Player.prototype;

  Player.build = function (container, drawing, worlds) {
    this.stage = NQD.element("div", container, { name: "stage" });
    this.charts = NQD.element("div", container, { name: "charts" });
    this.cursor = NQD.element("div", this.charts, { name: "cursor" });
    const bar = NQD.element("div", container, { name: "bar" });
    this.button = NQD.element("button", bar, {
      name: "play", text: "\u275a\u275a", title: "Play or pause (space)", type: "button",
      label: "Play or pause",
    });
    this.slider = NQD.element("input", bar, {
      name: "scrub", type: "range", label: "time",
    });
    this.slider.step = "any";
    this.slider.min = "0";
    this.clock = NQD.element("span", bar, { name: "clock" });
    this.rate = NQD.element("select", bar, { title: "Speed (+ and -)" });
    for (const speed of SPEEDS) {
      NQD.element("option", this.rate, { text: speed + "\u00d7" }).value = speed;
    }
    this.rate.value = 1;
    this.boxes = {};
    this.box(bar, "follow", "follow", "Camera follows the robot (f)", this.follow);
    this.box(bar, "trail", "trail", "Line: the way of the torso (t)", true);
    if (worlds > 1) {
      this.box(bar, "apart", "side by side", "Worlds beside each other (s)", false);
    }
    this.box(bar, "contacts", "impulses",
      "Arrows: contact impulses on the robot (c)", false);
    this.boxes.contacts.parentElement.hidden = true;
    const hidden = drawing.shapes.some((shape) => !shape.visual);
    if (hidden) this.box(bar, "colliders", "colliders", "Colliders (k)", false);
    this.box(bar, "origins", "link frames", "Axes at the origins of the links (o)", false);
    const home = NQD.element("button", bar, {
      text: "\u2302", title: "First view (h)", type: "button", label: "First view",
    });
    home.addEventListener("click", () => this.act("h"));
    const metres = this.options.unit === " steps" ? "" : " m"; // a maze has no unit
    const grid = NQD.element("span", bar, {
      text: "grid " + NQD.short(drawing.grid) + metres, name: "soft",
    });
    grid.title = "Distance of two thin lines on the ground; thick lines: five times that";
  };

  Player.box = function (bar, name, text, title, value) {
    const label = NQD.element("label", bar, { title: title });
    const box = NQD.element("input", label, { type: "checkbox" });
    NQD.element("span", label, { text: text });
    box.checked = value;
    this.boxes[name] = box;
    box.addEventListener("change", () => this.apply());
  };

  Player.listen = function () {
    this.button.addEventListener("click", () => this.act(" "));
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.rate.addEventListener("change", () => {
      this.speed = Number(this.rate.value);
    });
    this.charts.addEventListener("pointerdown", (event) => {
      this.charts.setPointerCapture(event.pointerId);
      this.seekChart(event);
    });
    this.charts.addEventListener("pointermove", (event) => {
      if (event.buttons) this.seekChart(event);
    });
    window.addEventListener("resize", () => this.resize());
    // the charts take their place from the view
    new ResizeObserver(() => this.view.resize()).observe(this.stage);
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      const field = event.target.tagName;
      if (field === "SELECT" || (field === "INPUT" && event.target.type !== "checkbox"
        && event.target.type !== "range")) return;
      if (field === "BUTTON" && (event.key === "Enter" || event.key === " ")) return;
      // a control does what its own keys stand for; the time slider goes by frames
      const moves = event.key.startsWith("Arrow") || ["Home", "End"].includes(event.key);
      if (event.target.type === "range" && event.target !== this.slider && moves) return;
      if (event.target.type === "checkbox" && event.key === " ") return;
      if (this.act(event.key)) event.preventDefault();
    });
  };

  // Does what a key stands for; returns whether it stands for something.
  Player.act = function (key) {
    const named = { f: "follow", t: "trail", s: "apart", c: "contacts",
      k: "colliders", o: "origins" };
    if (this.options.key && this.options.key(key)) return true;
    if (key === " ") {
      if (!this.playing && this.time >= this.duration()) this.time = 0;
      this.playing = !this.playing;
    } else if (["ArrowRight", "ArrowLeft", ".", ","].includes(key)) {
      const step = key === "ArrowRight" || key === "." ? 1 : -1;
      this.playing = false;
      this.seek((Math.round(this.time / this.dt) + step) * this.dt);
    } else if (key === "Home") this.seek(0);
    else if (key === "End") this.seek(this.duration());
    else if (key === "h") {
      this.view.home();
      this.aim(true);
    } else if (key === "+" || key === "-") {
      const index = SPEEDS.indexOf(this.speed) + (key === "+" ? 1 : -1);
      this.speed = SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)];
      this.rate.value = this.speed;
    } else if (named[key] && this.boxes[named[key]]) {
      this.boxes[named[key]].checked = !this.boxes[named[key]].checked;
      this.apply();
    } else return false;
    this.label();
    return true;
  };

  // Reads the check boxes.
  Player.apply = function () {
    const on = (name) => Boolean(this.boxes[name] && this.boxes[name].checked);
    this.follow = on("follow");
    this.showTrail = on("trail");
    this.view.origins.visible = on("origins");
    this.view.arrows.visible = on("contacts");
    for (const each of this.view.shapes) {
      if (!each.shape.visual) each.mesh.visible = on("colliders");
    }
    for (const line of this.view.trails) line.visible = this.showTrail;
    if (on("apart") !== Boolean(this.view.apart)) {
      this.view.arrange(on("apart"), this.spacing);
    }
    this.show();
    if (this.follow) this.aim(true);
  };

  // Loads a trajectory: {dt, q, lengths, rewards, descriptors, descriptor_names, feet,
  // contacts}, arrays decoded, with `worlds` worlds from world `first` on.
  Player.load = function (data) {
    this.data = data;
    this.dt = data.dt;
    this.stride = data.q.shape[1] * data.q.shape[2];
    this.slider.max = String(this.duration());
    this.spacing = this.extent();
    this.boxes.contacts.parentElement.hidden = !data.contacts;
    this.ways = [];
    const torso = 7 * this.view.drawing.torso;
    for (let w = 0; w < this.view.worlds; w++) {
      const way = new Float32Array(3 * data.q.shape[1]);
      for (let k = 0; k < data.q.shape[1]; k++) {
        this.view.pose(w, data.q.data, w * this.stride + k * data.q.shape[2]);
        const i = 7 * this.view.tree.size * w + torso;
        for (let c = 0; c < 3; c++) way[3 * k + c] = this.view.frames[i + c];
      }
      this.ways.push(way);
    }
    this.seek(0);
    this.aim(true);
    this.drawCharts();
  };

  // Distance between worlds that stand beside each other [m].
  Player.extent = function () {
    let low = 0, high = 0;
    for (const shape of this.view.drawing.shapes) {
      if (shape.body >= 0) continue;
      const reach = Math.max(...shape.size) + Math.min(...shape.size);
      low = Math.min(low, shape.frame[1] - reach);
      high = Math.max(high, shape.frame[1] + reach);
    }
    return Math.max(2.6 * this.view.drawing.radius, 1.2 * (high - low));
  };

  // Last moment at which a world still moves [s].
  Player.duration = function () {
    return Math.max(...this.data.lengths) * this.data.dt;
  };

  Player.seek = function (time) {
    this.time = Math.min(Math.max(time, 0), this.duration());
    this.show();
  };

  Player.seekChart = function (event) {
    const box = this.charts.getBoundingClientRect();
    this.seek((event.clientX - box.left) / box.width * this.duration());
  };

  // Poses all worlds at the present time.
  Player.show = function () {
    const data = this.data, view = this.view;
    if (!data) return;
    const nq = data.q.shape[2];
    const mixed = this.mixed || (this.mixed = new Float64Array(nq));
    for (let w = 0; w < view.worlds; w++) {
      const at = Math.min(this.time / this.dt, data.lengths[w]);
      const frame = Math.min(Math.floor(at), data.lengths[w]);
      const next = Math.min(frame + 1, data.lengths[w]);
      const start = w * this.stride;
      NQD.between(view.tree, data.q.data, start + frame * nq, start + next * nq,
        at - frame, mixed);
      view.pose(w, mixed, 0);
      if (this.showTrail) view.trail(w, this.ways[w], frame);
    }
    if (view.arrows.visible && data.contacts) this.impulses();
    view.place();
    if (this.follow) this.aim(false);
    this.slider.value = String(this.time);
    this.cursor.style.left = 100 * this.time / Math.max(this.duration(), 1e-9) + "%";
    this.label();
  };

  Player.label = function () {
    this.button.textContent = this.playing ? "\u275a\u275a" : "\u25b6";
    this.clock.textContent = this.time.toFixed(2) + " / "
      + (this.data ? this.duration() : 0).toFixed(2)
      + (this.options.unit === undefined ? " s" : this.options.unit);
  };

  // Turns the camera to the selected world; `jump` does so without the camera's lag.
  Player.aim = function (jump) {
    if (!this.follow && !jump) return;
    if (!this.view.drawing.follow && !this.follow) return;
    const p = this.aimed || (this.aimed = new THREE.Vector3());
    this.view.torso(this.selected, p);
    // the height stays, so that a hopping robot is seen to hop
    this.view.lookAt(p.x, p.y, this.view.controls.target.z);
  };

  Player.impulses = function () {
    const c = this.data.contacts, points = [], nc = c.body.length;
    const place = new Float64Array(3);
    for (let w = 0; w < this.view.worlds; w++) {
      const step = Math.min(Math.ceil(this.time / this.dt - 1e-9),
        this.data.lengths[w]) - 1;
      if (step < 0) continue;
      for (let i = 0; i < nc; i++) {
        const at = 3 * (nc * (this.data.rewards.shape[1] * w + step) + i);
        const x = c.impulse.data[at], y = c.impulse.data[at + 1];
        const z = c.impulse.data[at + 2], size = Math.hypot(x, y, z);
        if (size < 1e-3 * c.typical) continue;
        const b = 7 * (this.view.tree.size * w + c.body[i]);
        const local = c.position[i], f = this.view.frames;
        NQD.turn(f, b + 3, local[0], local[1], local[2], place, 0);
        const drop = c.ground[i] ? c.radius[i] : 0;
        const from = [f[b] + place[0], f[b + 1] + place[1] + this.view.shift[w],
          f[b + 2] + place[2] - drop];
        const cut = Math.min(1, LONGEST * c.typical / size);
        const scale = cut * ARROW * this.view.drawing.radius / c.typical;
        points.push(...from, from[0] + scale * x, from[1] + scale * y,
          from[2] + scale * z);
      }
    }
    this.view.impulses(points);
  };

  // Starts the loop that draws frames.
  Player.start = function () {
    let before = performance.now();
    this.cost = 0; // JavaScript of a frame [ms], a running mean
    const loop = (now) => {
      const began = performance.now();
      // the first time of a frame may be before `before`
      const passed = Math.min(Math.max((now - before) / 1000, 0), 0.1);
      before = now;
      if (this.playing && this.data) {
        this.time += passed * this.speed;
        if (this.time >= this.duration()) {
          this.time = this.options.repeat === false ? this.duration() : 0;
          this.playing = this.options.repeat !== false;
        }
        this.show();
      }
      this.view.render();
      this.cost += 0.05 * (performance.now() - began - this.cost);
      window.requestAnimationFrame(loop);
    };
    window.requestAnimationFrame(loop);
  };

  Player.resize = function () {
    this.view.resize();
    if (this.data) this.drawCharts();
  };

  Player.theme = function (name) {
    this.view.theme(name);
    if (this.data) this.drawCharts();
  };
})();
