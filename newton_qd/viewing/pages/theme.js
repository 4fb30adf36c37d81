// Light and dark: what the system prefers, until the button is used.
"use strict";

NQD.theme = function (...shown) {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let name = dark.matches ? "dark" : "light";
  const apply = () => {
    document.documentElement.dataset.theme = name;
    for (const each of shown) each.theme(name);
  };
  document.getElementById("theme").addEventListener("click", () => {
    name = name === "dark" ? "light" : "dark";
    apply();
  });
  dark.addEventListener("change", () => {
    name = dark.matches ? "dark" : "light";
    apply();
  });
  apply();
};
