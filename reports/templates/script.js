"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const alone = document.body.classList.contains("alone");  // one trial's own file
  const trials = alone ? [] : all("article.trial");
  const listed = all("table[data-searchable] tbody tr[id]");  // trials that have files of their own
  const boxes = all("#layers input");
  const filter = document.querySelector(".filter input");
  const help = document.getElementById("keys");
  let here = null;
  let remembered = null;

  all(".filter, .buttons, .keys-button").forEach((element) => { element.hidden = false; });

  // Trials: which one the reader is at, and the way to its neighbours among those that the filter leaves.
  const mark = (trial) => {
    if (here) here.classList.remove("here");
    here = trial;
    if (here) here.classList.add("here");
  };
  const go = (trial) => {
    history.replaceState(null, "", "#" + trial.id);
    mark(trial);
    trial.scrollIntoView({ behavior: "instant", block: "start" });
    trial.focus({ preventScroll: true });
  };
  // Files of their own: the neighbours are those that the list's filter and order left, as it was stored last.
  const shown = () => all("table[data-searchable] tbody tr").filter((row) => !row.hidden && row.querySelector("a[href^='trials/']"));
  const stored = () => {
    try { return JSON.parse(sessionStorage.getItem("teatbench trials")) ?? []; } catch { return []; }
  };
  const store = () => {
    const names = [...new Set(shown().map((row) => row.querySelector("a").getAttribute("href").slice(7, -5)))];
    try { sessionStorage.setItem("teatbench trials", JSON.stringify(names)); } catch { /* a browser may forbid it: the page's own order then holds */ }
  };
  const leave = (by) => {
    const names = stored();
    const at = names.indexOf(document.querySelector("article.trial").id);
    if (at >= 0 && names[at + by]) location.href = names[at + by] + ".html";
    else if (at < 0) document.querySelector(by > 0 ? "a[rel=next]" : "a[rel=prev]")?.click();
  };
  const walk = (by) => {
    const rows = shown();
    if (!rows.length) return;
    const next = rows[Math.min(Math.max(rows.indexOf(here) + by, 0), rows.length - 1)];
    mark(next);
    next.scrollIntoView({ behavior: "instant", block: "nearest" });
    next.querySelector("a").focus({ preventScroll: true });
  };
  const step = (by) => {
    if (alone) return leave(by);
    if (listed.length) return walk(by);
    const open = trials.filter((trial) => !trial.hidden);
    if (!open.length) return;
    const top = (trial) => trial.getBoundingClientRect().top;
    const at = open.indexOf(here);
    const seen = at >= 0 && top(here) < innerHeight && here.getBoundingClientRect().bottom > 0;
    const last = open.length - 1;
    if (seen) go(open[Math.min(Math.max(at + by, 0), last)]);
    else go(by > 0 ? open.find((trial) => top(trial) > innerHeight / 4) ?? open[last] : open.findLast((trial) => top(trial) < 0) ?? open[0]);
  };
  const arrive = () => {
    if (location.hash === "#filter") return find();
    const row = listed.find((one) => "#" + one.id === location.hash);
    if (row) {
      if (row.hidden) clear();
      mark(row);
      row.scrollIntoView({ behavior: "instant", block: "center" });
      return;
    }
    const trial = trials.find((one) => "#" + one.id === location.hash);
    const elsewhere = document.body.dataset.list;
    if (elsewhere && location.hash.startsWith("#trial-") && !document.querySelector(location.hash)) return location.replace(elsewhere + location.hash);
    if (trial && trial.hidden) clear();
    mark(trial || null);
    if (trial) trial.scrollIntoView({ behavior: "instant", block: "start" });
  };

  // Layers: the check boxes work by style sheet alone; here only the switch for all of them.
  const overlays = () => {
    const shown = boxes.filter((box) => box.checked);
    boxes.forEach((box) => { box.checked = shown.length ? false : !remembered || remembered.includes(box); });
    remembered = shown.length ? shown : null;
  };

  // Searchable tables: filter by every word typed, sort by a column.
  const byId = new Map(trials.map((trial) => ["#" + trial.id, trial]));
  const sift = (input) => {
    const part = input.closest(".part");
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const rows = all("tbody tr", part);
    const left = new Map();  // trials, by whether one of their rows is left: each detector has one
    rows.forEach((row) => {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      const link = row.querySelector("a[href^='#']");
      const trial = link && byId.get(link.getAttribute("href"));
      if (trial) left.set(trial, left.get(trial) || !row.hidden);
    });
    left.forEach((is, trial) => { trial.hidden = !is; });
    part.querySelector(".count").textContent = words.length ? rows.filter((row) => !row.hidden).length + " of " + rows.length : "";
  };
  const clear = () => all(".filter input").forEach((input) => { input.value = ""; sift(input); });
  const worth = (cell) => {
    const text = cell.dataset.sort ?? cell.textContent.trim();
    const number = Number(text.replace("\u2212", "-").match(/^[^\d-]{0,2}(-?\d+(\.\d+)?)/)?.[1] ?? NaN);
    return Number.isNaN(number) ? text.toLowerCase() : number;
  };
  const order = (a, b) => {
    if (typeof a === typeof b) return a < b ? -1 : a > b ? 1 : 0;
    return typeof a === "number" ? -1 : 1;
  };
  const sort = (head) => {
    const table = head.closest("table");
    const column = [...head.parentNode.children].indexOf(head);
    const down = head.getAttribute("aria-sort") === "ascending";
    all("th[aria-sort]", table).forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = all("tbody tr", table).map((row) => [worth(row.children[column]), row]);
    rows.sort((a, b) => (down ? -1 : 1) * order(a[0], b[0]));
    table.tBodies[0].append(...rows.map((pair) => pair[1]));
  };
  all("table[data-searchable] thead th").forEach((head) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(head.firstChild);  // the title; the unit stays below it
    button.addEventListener("click", () => sort(head));
    head.prepend(button);
  });
  all(".filter input").forEach((input) => input.addEventListener("input", () => sift(input)));

  const find = () => {
    const list = alone ? document.querySelector("a[rel=up]").getAttribute("href").split("#")[0] : document.body.dataset.list;
    if (list && !filter) location.href = list + "#filter";
    else if (filter) { filter.scrollIntoView({ block: "center" }); filter.focus(); filter.select(); }
  };

  // A point of a figure leads to its trial's row; from there on to the trial's file.
  all(".plot a").forEach((link) => link.addEventListener("click", (event) => {
    const row = listed.find((one) => "#" + one.id === link.getAttribute("href"));
    if (!row) return;
    event.preventDefault();
    store();
    location.href = row.querySelector("a").href;
  }));
  if (listed.length) document.querySelector("main").addEventListener("click", (event) => { if (event.target.closest("a[href^='trials/']")) store(); });

  const acts = {
    help: () => (help.open ? help.close() : help.showModal()),
    overlays,
    whole: pictures.whole,
  };
  all("[data-act]").forEach((button) => button.addEventListener("click", () => acts[button.dataset.act]()));
  const keys = {
    j: () => step(1),
    k: () => step(-1),
    o: overlays,
    z: pictures.whole,
    "+": pictures.nearer,
    "=": pictures.nearer,
    "-": pictures.farther,
    0: pictures.back,
    "?": acts.help,
    "/": find,
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const typing = event.target.matches("input[type=search], textarea, select");
    if (event.key === "Escape") {
      if (help.open) return;
      if (alone) return document.querySelector("a[rel=up]").click();
      clear();
      document.activeElement.blur();
    } else if (!typing && Object.hasOwn(keys, event.key) && (!help.open || event.key === "?")) {
      event.preventDefault();
      keys[event.key]();
    }
  });

  // The contents mark the chapter that is being read.
  const links = new Map(all("#contents li a").map((link) => [link.getAttribute("href").slice(1), link]));
  const seen = new IntersectionObserver((entries) => {
    entries.filter((entry) => entry.isIntersecting).forEach((entry) => {
      links.forEach((link) => link.removeAttribute("aria-current"));
      links.get(entry.target.id)?.setAttribute("aria-current", "true");
    });
  }, { rootMargin: "-10% 0px -80% 0px" });
  all("section.chapter").forEach((section) => seen.observe(section));

  const unfold = () => {
    const goal = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!goal) return;
    const closed = all("details", goal.matches(".folded") ? goal : undefined).filter((fold) => !fold.open && (fold.contains(goal) || fold.parentElement === goal));
    closed.forEach((fold) => { fold.open = true; });
    if (closed.length) goal.scrollIntoView();
  };
  document.addEventListener("click", (event) => { if (event.target.closest("a[href^='#']")?.hash === location.hash) unfold(); });
  window.addEventListener("hashchange", unfold);
  window.addEventListener("hashchange", arrive);
  unfold();
  if (location.hash) arrive();
})();
