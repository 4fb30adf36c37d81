// The replay page: one trajectory of one or more worlds.
"use strict";

(function () {
  const data = NQD.data();
  const trajectory = data.trajectory;
  for (const name of ["q", "rewards", "descriptors", "feet"]) {
    trajectory[name] = NQD.decode(trajectory[name]);
  }
  if (trajectory.contacts) {
    const c = trajectory.contacts;
    c.impulse = NQD.decode(c.impulse);
    const sizes = [];
    for (let i = 0; i < c.impulse.data.length; i += 3) {
      const size = Math.hypot(
        c.impulse.data[i], c.impulse.data[i + 1], c.impulse.data[i + 2]);
      if (size > 0) sizes.push(size);
    }
    sizes.sort((a, b) => a - b);
    // a single impact does not make all other arrows short
    c.typical = sizes.length ? sizes[Math.floor(0.9 * (sizes.length - 1))] : 1;
  }
  document.getElementById("title").textContent = data.title;
  const worlds = trajectory.labels.length;
  const player = new NQD.Player(
    document.getElementById("player"), trajectory.drawing, worlds,
    { unit: trajectory.unit });
  const facts = document.getElementById("facts");
  const chosen = NQD.element("select", facts, { title: "World that is followed" });
  trajectory.labels.forEach((label, w) => {
    const length = trajectory.lengths[w], steps = trajectory.rewards.shape[1];
    let sum = 0;
    for (let k = 0; k < length; k++) sum += trajectory.rewards.data[w * steps + k];
    const text = label + ", return " + NQD.short(sum) + ", " + length + " steps";
    NQD.element("option", chosen, { text: text }).value = w;
  });
  chosen.addEventListener("change", () => {
    player.selected = Number(chosen.value);
    player.drawCharts();
    player.show();
    player.aim(true);
  });
  NQD.theme(player);
  player.load(trajectory);
  player.apply();
  player.start();
  NQD.player = player;
})();
