"use strict";
// What a link names is opened: run, configuration, trace.
function open_target() {
  const part = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (part && part.tagName === "DETAILS") { part.open = true; part.scrollIntoView(); }
}
addEventListener("hashchange", open_target);
open_target();

// A heading sorts its column: downwards, upwards, then as it was. What is no number comes last.
const number_of = (cell) => {
  const text = (cell.title || cell.textContent).trim().replace(/,(?=\d{3})/g, "");
  return /^[+-]?[\d.]/.test(text) ? parseFloat(text) : NaN;
};
const sort = (table, column, direction) => {
  const body = table.tBodies[0];
  const rows = [...body.rows];
  rows.forEach((row, place) => (row.dataset.place ??= place));
  rows.sort((a, b) => {
    const [left, right] = [a, b].map((row) => number_of(row.cells[column]));
    const was = a.dataset.place - b.dataset.place;
    if (!direction) return was;
    if (!isNaN(left) && !isNaN(right) && column) return direction * (left - right) || was;
    if (isNaN(left) !== isNaN(right) && column) return isNaN(left) - isNaN(right);
    const [one, other] = [a, b].map((row) => row.cells[column].textContent);
    return direction * one.localeCompare(other) || was;
  });
  body.append(...rows);
};
for (const table of document.querySelectorAll("table")) {
  const heads = [...table.tHead.rows].at(-1).cells;
  [...heads].forEach((head, column) => {
    // No <button>: on paper, a heading that is repeated on the next sheet would lack it.
    const button = Object.assign(document.createElement("span"), { tabIndex: 0 });
    button.setAttribute("role", "button");
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("keydown", (event) => event.key === "Enter" && button.click());
    button.addEventListener("click", () => {
      const next = { none: "descending", descending: "ascending", ascending: "none" }[head.ariaSort];
      for (const other of heads) other.ariaSort = "none";
      head.ariaSort = next;
      sort(table, column, { none: 0, descending: -1, ascending: 1 }[next]);
    });
  });
}

// The mark of a figure that is nearest to the pointer says what it is: most are too small to hit.
const says = document.body.appendChild(Object.assign(document.createElement("div"), { id: "says", hidden: true }));
const REACH = 16;
for (const figure of document.querySelectorAll("figure svg")) {
  const marks = [...figure.querySelectorAll(":is(use, path) > title")].map((title) => title.parentNode);
  figure.addEventListener("pointerleave", () => (says.hidden = true));
  figure.addEventListener("pointermove", (event) => {
    let [nearest, distance] = [null, REACH];
    for (const mark of marks) {
      const box = mark.getBoundingClientRect();
      const away = Math.hypot(box.x + box.width / 2 - event.clientX, box.y + box.height / 2 - event.clientY);
      if (away < distance) [nearest, distance] = [mark, away];
    }
    says.hidden = nearest === null;
    if (!nearest) return;
    says.textContent = nearest.firstElementChild.textContent;
    const left = Math.min(event.pageX + 12, scrollX + innerWidth - says.offsetWidth - 8);
    says.style.left = `${Math.max(left, 0)}px`;
    says.style.top = `${event.pageY + 16}px`;
  });
}

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
