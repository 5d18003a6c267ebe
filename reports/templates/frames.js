"use strict";
// Frames: larger, whole, zoomed, moved. The frames of one trial go together, so that all of them show the same teat.
const pictures = (() => {
  const LEAST_PX = 16;      // of the image, across a frame: nearer shows nothing more
  const SQUARES_FROM = 3;   // screen pixels for one of the image's: from there on it is shown as the square that it is
  const STEP = 1.5;
  const between = (least, value, most) => Math.min(Math.max(value, least), most);
  const numbers = (text) => text.split(" ").map(Number);
  const middle = ([x, y, width, height]) => [x + width / 2, y + height / 2];

  const marksOf = (svg) => new Map([...svg.querySelectorAll(".layer-truth circle")].map((circle) => [
    circle.textContent, [circle.cx.baseVal.value, circle.cy.baseVal.value],
  ]));
  const frameOf = (figure) => {
    const pane = figure.querySelector(".pane");
    const svg = pane.querySelector("svg");
    const part = numbers(svg.getAttribute("viewBox"));
    const caption = figure.querySelector("figcaption");
    return {
      figure, pane, svg, caption, part, view: part, full: numbers(svg.dataset.whole), image: pane.querySelector("img"),
      name: caption.textContent, marks: marksOf(svg), trial: figure.closest(".trial"), pointers: new Map(),
    };
  };
  const frames = [...document.querySelectorAll(".frame")].map(frameOf);
  // A detector's picture of a stage shows no truth: it is taken for the trial's frame of the same size.
  const alike = (frame, other) => other.trial === frame.trial && other.marks.size && String(other.full) === String(frame.full);
  frames.filter(({ marks }) => !marks.size).forEach((frame) => { frame.marks = frames.findLast((other) => alike(frame, other))?.marks ?? frame.marks; });

  // A view is x, y, width and height in pixels of the image, as in the drawing's viewBox.
  const home = (frame) => (document.body.classList.contains("whole") ? frame.full : frame.part);
  const isHome = (frame) => frame.view.every((value, at) => Math.abs(value - home(frame)[at]) < 0.01);
  const widest = (frame) => Math.min(frame.full[2], frame.full[3] * home(frame)[2] / home(frame)[3]);
  const allowed = (frame, width) => between(Math.min(LEAST_PX, widest(frame)), width, widest(frame));
  const viewAt = (frame, [x, y], wanted) => {
    const [left, top, fullWidth, fullHeight] = frame.full;
    const width = allowed(frame, wanted);
    const height = width * home(frame)[3] / home(frame)[2];
    const put = (at, size, from, full) => between(from, at - size / 2, from + full - size);
    return [put(x, width, left, fullWidth), put(y, height, top, fullHeight), width, height];
  };
  const draw = (frame) => {
    const [x, y, width, height] = frame.view;
    const moved = !isHome(frame);
    const { style } = frame.image;
    frame.svg.setAttribute("viewBox", frame.view.join(" "));
    frame.svg.setAttribute("font-size", width / 26);
    style.left = moved ? -100 * (x - frame.full[0]) / width + "%" : "";
    style.top = moved ? -100 * (y - frame.full[1]) / height + "%" : "";
    style.width = moved ? 100 * frame.full[2] / width + "%" : "";
    frame.pane.classList.toggle("moved", moved);
    frame.pane.classList.toggle("squares", moved && frame.pane.clientWidth / width >= SQUARES_FROM);
    frame.back.hidden = !moved;
    frame.back.textContent = (home(frame)[2] / width).toFixed(1) + "×";
  };

  // Where another camera sees what this one has in its middle: by the truth that both show, the nearest counting most.
  const counterpart = (frame, other) => {
    const [x, y] = middle(frame.view);
    const ratio = home(other)[2] / home(frame)[2];
    const sum = [0, 0, 0];
    frame.marks.forEach(([markX, markY], name) => {
      const there = other.marks.get(name);
      if (!there) return;
      const weight = 1 / (1 + (x - markX) ** 2 + (y - markY) ** 2) ** 2;
      sum[0] += weight * (there[0] + (x - markX) * ratio);
      sum[1] += weight * (there[1] + (y - markY) * ratio);
      sum[2] += weight;
    });
    if (sum[2]) return [sum[0] / sum[2], sum[1] / sum[2]];
    const [mine, theirs] = [home(frame), home(other)];
    return [theirs[0] + (x - mine[0]) * theirs[2] / mine[2], theirs[1] + (y - mine[1]) * theirs[3] / mine[3]];
  };
  const show = (frame, view) => {
    frame.view = view;
    const nearness = home(frame)[2] / view[2];
    const same = isHome(frame);
    frames.filter((other) => other.trial === frame.trial).forEach((other) => {
      if (same) other.view = home(other);
      else if (other !== frame) other.view = viewAt(other, counterpart(frame, other), home(other)[2] / nearness);
      draw(other);
    });
  };
  const back = (frame) => show(frame, home(frame));
  // The point of the image that `point` names stays where it is; on its way out the view stops once where it began.
  const zoom = (frame, factor, point = middle(frame.view)) => {
    const [x, y] = middle(frame.view);
    const first = home(frame)[2];
    const wanted = allowed(frame, frame.view[2] / factor);
    if (frame.view[2] < first * 0.999 && wanted >= first * 0.999) return back(frame);
    const ratio = wanted / frame.view[2];
    show(frame, viewAt(frame, [point[0] + (x - point[0]) * ratio, point[1] + (y - point[1]) * ratio], wanted));
  };
  const move = (frame, byX, byY) => {  // in parts of the view
    const [x, y] = middle(frame.view);
    show(frame, viewAt(frame, [x + byX * frame.view[2], y + byY * frame.view[3]], frame.view[2]));
  };

  // Pointers: a wheel over a frame that was clicked, or with Ctrl; one that draws; two that pinch; a double click.
  const pixelAt = (frame, [clientX, clientY]) => {
    const box = frame.pane.getBoundingClientRect();
    const [x, y, width, height] = frame.view;
    return [x + (clientX - box.left) / box.width * width, y + (clientY - box.top) / box.height * height];
  };
  const onWheel = (frame, event) => {
    const meant = event.ctrlKey || event.metaKey;
    if (!meant && document.activeElement !== frame.pane) return;
    const factor = Math.exp(-between(-30, event.deltaY * (event.deltaMode ? 20 : 1), 30) / 100);
    if (!meant && allowed(frame, frame.view[2] / factor) === frame.view[2]) return;  // as far as it goes: the page may scroll on
    event.preventDefault();
    zoom(frame, factor, pixelAt(frame, [event.clientX, event.clientY]));
  };
  const grip = (pointers) => {
    const [first, second] = [...pointers.values()];
    if (!second) return { at: first, span: 1 };
    return { at: [(first[0] + second[0]) / 2, (first[1] + second[1]) / 2], span: Math.hypot(first[0] - second[0], first[1] - second[1]) || 1 };
  };
  const onMove = (frame, event) => {
    if (!frame.pointers.has(event.pointerId)) return;
    const before = grip(frame.pointers);
    frame.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = grip(frame.pointers);
    const box = frame.pane.getBoundingClientRect();
    move(frame, (before.at[0] - after.at[0]) / box.width, (before.at[1] - after.at[1]) / box.height);
    if (after.span !== before.span) zoom(frame, after.span / before.span, pixelAt(frame, after.at));
  };
  const listen = (frame) => {
    const { pane, pointers } = frame;
    const drop = (event) => pointers.delete(event.pointerId);
    pane.addEventListener("wheel", (event) => onWheel(frame, event), { passive: false });
    pane.addEventListener("pointerdown", (event) => {
      if (event.button || pointers.size > 1) return;
      pane.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    pane.addEventListener("pointermove", (event) => onMove(frame, event));
    ["pointerup", "pointercancel", "lostpointercapture"].forEach((kind) => pane.addEventListener(kind, drop));
    pane.addEventListener("dblclick", (event) => zoom(frame, event.shiftKey ? 0.4 : 2.5, pixelAt(frame, [event.clientX, event.clientY])));
  };

  // Keys and buttons.
  const STEPS = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] };
  const arrows = (frame, event) => {
    if (!Object.hasOwn(STEPS, event.key) || isHome(frame) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    move(frame, ...STEPS[event.key]);
  };
  const button = (text, label, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", () => act(made));
    return made;
  };
  const enlarge = (frame, pressed) => {
    pressed.setAttribute("aria-pressed", frame.figure.classList.toggle("large"));
    draw(frame);
  };
  const equip = (frame) => {
    const tools = document.createElement("span");
    const link = frame.pane.querySelector("a");  // without a script the picture itself leads to the original
    tools.className = "tools";
    frame.back = button("", `Zoom back, ${frame.name}`, () => { back(frame); frame.pane.focus({ preventScroll: true }); });
    const large = button("Enlarge", `Enlarge ${frame.name}`, (made) => enlarge(frame, made));
    large.setAttribute("aria-pressed", "false");
    const steps = [button("−", `Zoom out, ${frame.name}`, () => zoom(frame, 1 / STEP)), button("+", `Zoom in, ${frame.name}`, () => zoom(frame, STEP))];
    [frame.back, ...steps].forEach((one) => { one.tabIndex = -1; });  // for pointers: the keys + − 0 do the same, and tabbing on stays short
    tools.append(frame.back, ...steps, large);
    if (link) {
      link.replaceWith(...link.childNodes);
      link.textContent = "Original";
      link.setAttribute("aria-label", `Original of ${frame.name}`);
      tools.append(link);
    }
    frame.caption.append(tools);
    frame.image.draggable = false;
    frame.pane.classList.add("live");
    frame.pane.tabIndex = 0;
    frame.pane.setAttribute("role", "group");
    frame.pane.setAttribute("aria-label", `${frame.name}: + and − zoom, arrow keys move, 0 goes back`);
    frame.pane.addEventListener("keydown", (event) => arrows(frame, event));
    frame.back.hidden = true;
    listen(frame);
  };
  frames.forEach(equip);

  // What a key means that no frame has: the trial that is read.
  const meant = () => {
    const seen = ({ trial }) => { const box = trial.getBoundingClientRect(); return box.bottom > 0 && box.top < innerHeight; };
    return frames.find(({ figure }) => figure.contains(document.activeElement))
      ?? frames.find((frame) => frame.trial.classList.contains("here") && seen(frame)) ?? frames.find((frame) => !frame.trial.hidden && seen(frame));
  };
  const withMeant = (act) => () => { const frame = meant(); if (frame) act(frame); };
  const whole = () => {
    const on = document.body.classList.toggle("whole");
    document.querySelectorAll("[data-act=whole]").forEach((pressed) => pressed.setAttribute("aria-pressed", on));
    frames.forEach((frame) => { frame.view = home(frame); draw(frame); });
  };
  return { whole, nearer: withMeant((frame) => zoom(frame, STEP)), farther: withMeant((frame) => zoom(frame, 1 / STEP)), back: withMeant(back) };
})();
