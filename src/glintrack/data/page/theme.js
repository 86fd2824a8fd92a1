"use strict";
// Dark and light: as the system says, until the button is pressed.
const theme = {
  start(changed) {
    const button = document.getElementById("theme");
    const set = (dark) => {
      document.documentElement.dataset.theme = dark ? "dark" : "light";
      button.textContent = dark ? "Switch to light" : "Switch to dark";
      changed();
    };
    set(matchMedia("(prefers-color-scheme: dark)").matches);
    button.addEventListener("click", () => set(document.documentElement.dataset.theme !== "dark"));
  },
};
