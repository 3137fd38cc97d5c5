"use strict";
// What a link names is opened: run, configuration, trace.
function open_target() {
  const part = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (part && part.tagName === "DETAILS") { part.open = true; part.scrollIntoView(); }
}
addEventListener("hashchange", open_target);
open_target();

// Two images of one view over each other; the slider says where one ends and the other begins.
const store = document.getElementById("pictures");
if (store) {
  const views = JSON.parse(store.textContent);
  const [view, left, right] = ["view", "left", "right"].map((name) => document.getElementById(`choose-${name}`));
  const stage = document.querySelector(".stage");
  const [under, over] = stage.querySelectorAll("img");
  const fill = (list, names, index) =>
    list.replaceChildren(...names.map((name, at) => new Option(name, at, at === index, at === index)));
  const show = () => {
    const shown = views[view.value].images;
    for (const [list, image, mark] of [[left, under, ".left"], [right, over, ".right"]]) {
      const one = shown[list.value];
      image.src = one.data;
      image.alt = `${one.name}, ${views[view.value].name}`;
      stage.querySelector(mark).textContent = one.label;
    }
  };
  const change = () => {
    const names = views[view.value].images.map((one) => one.name);
    const kept = (list, otherwise) => Math.max(names.indexOf(list.selectedOptions[0]?.text ?? names[otherwise]), 0);
    const chosen = [kept(left, 0), kept(right, names.length > 2 ? 2 : 1)];
    fill(left, names, chosen[0]);
    fill(right, names, chosen[1]);
    show();
  };
  fill(view, views.map((one) => one.name), 0);
  change();
  view.addEventListener("change", change);
  left.addEventListener("change", show);
  right.addEventListener("change", show);
  stage.querySelector("input").addEventListener("input", (event) =>
    stage.style.setProperty("--at", `${event.target.value}%`));
}
