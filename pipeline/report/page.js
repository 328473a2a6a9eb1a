"use strict";

// Two pictures side by side become one over the other, with a line between them that pointer and keys move.
for (const stage of document.querySelectorAll(".stage")) {
  const range = document.createElement("input");
  range.type = "range";
  range.value = 50;
  range.setAttribute("aria-label", stage.dataset.label);
  const grip = document.createElement("span");
  grip.className = "grip";
  grip.textContent = "⇔";
  grip.setAttribute("aria-hidden", "true");
  const show = () => {
    stage.style.setProperty("--at", range.value + "%");
    range.setAttribute("aria-valuetext", range.value + " % " + stage.dataset.left);
    stage.querySelector(".left .tag").hidden = range.value < 15;
    stage.querySelector(".right .tag").hidden = range.value > 85;
  };
  const follow = (event) => {
    const box = stage.getBoundingClientRect();
    range.value = (100 * (event.clientX - box.left)) / box.width;
    show();
  };
  stage.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    stage.setPointerCapture(event.pointerId);
    range.focus({ preventScroll: true });
    follow(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (stage.hasPointerCapture(event.pointerId)) follow(event);
  });
  range.addEventListener("input", show);
  stage.append(grip, range);
  stage.classList.add("live");
  show();
}

// Heads of columns become buttons that sort; rows without a number stay last.
for (const head of document.querySelectorAll("th[data-sort]")) {
  const button = document.createElement("button");
  button.type = "button";
  button.append(...head.childNodes);
  head.append(button);
  button.addEventListener("click", () => {
    const rising = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", rising ? "ascending" : "descending");
    const body = head.closest("table").tBodies[0];
    const key = (row) => row.cells[head.cellIndex].dataset.value;
    const compare = (a, b) => {
      if (a === "" || b === "") return (a === "") - (b === "");
      const order = isNaN(a) || isNaN(b) ? a.localeCompare(b) : a === b ? 0 : a - b;
      return rising ? order : -order;
    };
    body.append(...[...body.rows].sort((a, b) => compare(key(a), key(b))));
  });
}

// Charts tell the numbers under the pointer, or step by step with the arrow keys.
for (const plot of document.querySelectorAll(".plot")) {
  const lines = JSON.parse(plot.dataset.points);
  const svg = plot.querySelector("svg");
  const output = plot.querySelector("output");
  const atRest = output.textContent;
  const cursor = svg.querySelector("path").cloneNode();
  cursor.removeAttribute("d");
  cursor.setAttribute("class", "cursor");
  svg.append(cursor);
  svg.setAttribute("tabindex", "0");
  const longest = lines.reduce((a, b) => (b.points.length > a.points.length ? b : a)).points;
  let at = longest.length - 1;
  const nearest = (points, x) => points.reduce((a, b) => (Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a));
  const show = (x) => {
    const [where, , step] = nearest(longest, x);
    at = longest.findIndex((point) => point[0] === where);
    cursor.setAttribute("d", `M${where} 10V200`);
    const words = lines.map((line) => {
      const [, , recorded, number] = nearest(line.points, where);
      const name = lines.length > 1 ? line.name + " " : "";
      return `${name}${number}${recorded === step ? "" : ` (step ${recorded})`}`;
    });
    output.textContent = `step ${step}: ${words.join(" · ")}`;
  };
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    show(((event.clientX - box.left) / box.width) * 420);
  });
  svg.addEventListener("pointerleave", () => {
    cursor.removeAttribute("d");
    output.textContent = atRest;
  });
  svg.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    show(longest[Math.min(Math.max(at + by, 0), longest.length - 1)][0]);
  });
}

// On paper nothing can be opened.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => (d.open = true)));
