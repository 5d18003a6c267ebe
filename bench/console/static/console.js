// The page: a list of runs, or one run that it follows. All state comes from the server; text is
// only ever set as text.

const [token, hint] = location.hash.slice(1).split("#");
if (token && !token.startsWith("/")) {
  sessionStorage.setItem("token", token.startsWith("pair-") ? await exchanged(token.slice(5)) : token);
  history.replaceState(null, "", "#/" + (hint || ""));
}
const TOKEN = sessionStorage.getItem("token") || "";
// a code from another page's QR code, good once, for the token
async function exchanged(code) {
  const options = { method: "POST", headers: { Authorization: `Bearer ${code}`, "Content-Type": "application/json" }, body: "{}" };
  const found = await fetch("/api/paired", options).then((answer) => answer.json()).catch(() => ({}));
  return found.token || "";
}
const CLIENT = sessionStorage.getItem("client") || crypto.randomUUID();
sessionStorage.setItem("client", CLIENT);
const NAME = /Mobi|Android/.test(navigator.userAgent) ? "a telephone or tablet" : "a computer's browser";
const RETRY_MS = 1000, SILENT_S = 5, EVENTS = 40, TRUTH = "#5dff8f", TONES = ["#7cc4ff", "#ffb454", "#e9a6ff", "#ffffff"];
// of an answer by its detector's place, colours and marks as in the report: cross, square, triangle, diamond
const MARKS = ["✕", "□", "△", "◇"], form = (who) => (who - 1 + Math.floor((who - 1) / 4)) % 4;
const marked = (who, x, y, r) => [`M${x - r} ${y - r}l${2 * r} ${2 * r}M${x - r} ${y + r}l${2 * r} ${-2 * r}`, `M${x - r} ${y - r}h${2 * r}v${2 * r}h${-2 * r}z`, `M${x} ${y - 1.2 * r}L${x + r} ${y + r}H${x - r}z`, `M${x} ${y - 1.3 * r}L${x + 1.3 * r} ${y}L${x} ${y + 1.3 * r}L${x - 1.3 * r} ${y}z`][form(who)];
const SHOWN = { left: "left camera", right: "right camera", thermal: "thermal camera" };
const BAD = ["trip", "fault", "dropped out", "invalid"]; // kinds of events
const main = document.getElementById("main"), controls = document.getElementById("controls");
const byId = (id) => document.getElementById(id);

function make(tag, given = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (name in node && name !== "list") node[name] = value;
    else node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}
function draw(tag, given = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(given)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}
const headers = (more = {}) => ({ Authorization: `Bearer ${TOKEN}`, "X-Client": CLIENT, ...more });
// values as pages write them: messages have degC, which any terminal can show; a folder's name stays as it is
const values = (text) => text.replace(/(\d) degC\b/g, "$1 °C");
const read = (text) => JSON.parse(text, (key, value) => (typeof value === "string" && !["name", "run"].includes(key) ? values(value) : value));
async function ask(path, body) {
  const options = body === undefined
    ? { headers: headers() }
    : { method: "POST", headers: headers({ "Content-Type": "application/json" }), body: JSON.stringify(body) };
  const answer = await fetch(`/api${path}`, options).catch(() => { throw new Error("The console can't be reached. The page says when it can again."); });
  const found = await answer.text().then(read).catch(() => ({ error: answer.statusText }));
  if (!answer.ok) throw Object.assign(new Error(found.error), { status: answer.status });
  return found;
}
async function picture(path) {
  const answer = await fetch(`/api${path}`, { headers: headers() });
  return answer.ok ? URL.createObjectURL(await answer.blob()) : null;
}
function minutes(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}
const number = (value, unit, digits = 2) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)} ${unit}`);

// ---- one run ----
let run = null; // {name, ...}: what is known of the run on the page
let stop = new AbortController();
const beep = { on: false, context: null };

async function follow(name) {
  const mine = (stop = new AbortController());
  let last = "";
  while (!mine.signal.aborted) {
    try {
      const more = last ? { "Last-Event-ID": last } : {};
      const answer = await fetch(`/api/runs/${encodeURIComponent(name)}/stream`, { headers: headers(more), signal: mine.signal });
      if (!answer.ok) {
        showStatus((await answer.json()).error || answer.statusText, true);
        if (answer.status === 404 || answer.status === 401) return;
        throw new Error(answer.statusText);
      }
      showStatus("connected");
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { value, done } = await quickly(reader.read());
        if (done) break;
        text += value;
        const whole = text.split("\n\n");
        text = whole.pop();
        for (const message of whole) {
          const fields = Object.fromEntries(message.split("\n").filter((line) => line[0] !== ":").map((line) => [line.slice(0, line.indexOf(":")), line.slice(line.indexOf(":") + 2)]));
          if (fields.id) last = fields.id;
          if (fields.event) received(fields.event, read(fields.data));
        }
      }
    } catch (error) {
      if (mine.signal.aborted) return;
    }
    showStatus("no connection to the console: trying again. The run goes on.", true);
    await new Promise((then) => { setTimeout(then, RETRY_MS); addEventListener("online", then, { once: true }); });
  }
}
// a connection that says nothing for long is a dead one (the server sends a comment every 10 s), and
// so is one from before the network went
function quickly(promise) {
  const after = new AbortController();
  const dead = new Promise((_, fail) => {
    const lost = setTimeout(() => fail(new Error("silence")), 25000);
    addEventListener("offline", () => fail(new Error("no network")), { signal: after.signal });
    after.signal.addEventListener("abort", () => clearTimeout(lost));
  });
  return Promise.race([promise, dead]).finally(() => after.abort());
}
byId("pair").onclick = async () => {
  try {
    const { url, qr, here } = await ask("/pair", {});
    const place = byId("pairing");
    const where = here ? "Only this machine reaches this console. For a phone start it with: teatbench console --listen ADDRESS" : "Scan it with a phone in the same network. It works once, for 10 minutes; the phone may then answer, start and end runs.";
    place.replaceChildren(heading("Pair a phone"), make("img", { src: qr, alt: "QR code of the link below" }), make("p", {}, make("a", { href: url, target: "_blank", rel: "noopener" }, url)), make("p", { className: here ? "warn" : "soft" }, where), make("button", { className: "quiet", onclick: () => place.close() }, "Close"));
    place.showModal();
  } catch (error) { problem(error.message); }
};
function showStatus(text, lost = false) {
  byId("connection").textContent = text;
  byId("connection").classList.toggle("lost", lost);
}
function received(kind, value) {
  if (kind === "snapshot") {
    Object.assign(run, value, { name: run.name });
    page();
  } else if (kind === "event") {
    if (["event", "warning"].includes(value.what)) {
      run.events.push(value);
      run.events.splice(0, run.events.length - EVENTS);
      events();
    }
    if (value.what === "event" && value.kind === "end") refreshed();
    if (value.what === "trial") trials();
  } else {
    run[kind] = value;
    if (kind === "live" || kind === "status") live();
    if (kind === "status") ended();
    if (kind === "prompt") prompted(value);
    if (kind === "practice") practice();
    if (kind === "lease") leased();
  }
}
// the report comes some seconds after the run's end
async function refreshed(tries = 40) {
  const mine = run, found = await ask(at("")).catch(() => null);
  if (run !== mine) return;
  if (found) { run.run = found.run; run.status = found.status; live(); ended(); trials(); }
  if (tries && !run.run.report) setTimeout(() => run === mine && refreshed(tries - 1), 1500);
}
const at = (path) => `/runs/${encodeURIComponent(run.name)}${path}`;

const heading = (text) => make("h2", {}, text);
const card = (given, ...children) => make("section", { ...given, className: `card ${given.className || ""}` }, ...children);
function page() {
  byId("title").textContent = run.run.title;
  run.framesShown = run.lastTrial = undefined;
  // a prompt that was there before the connection was lost keeps what was ticked and typed
  const kept = run.prompt && run.asked === run.prompt.number ? byId("ask") : null;
  if (!kept) run.asked = 0;
  main.replaceChildren(
    card({ id: "tip", hidden: true }),
    kept || card({ id: "ask", hidden: true, "aria-live": "assertive" }),
    card({ id: "problem", className: "bad", hidden: true, role: "alert" }),
    card({ className: "wide" }, make("p", { id: "doing", className: "big" }), make("ul", { id: "unsafe", className: "next" }), make("p", { id: "tripped", className: "big bad" }), make("p", { id: "step", className: "step" }), make("ul", { id: "next", className: "next" }), make("p", { id: "trial", className: "soft" }), make("progress", { id: "done", max: 1, value: 0, ariaLabel: "trials done" }), make("div", { id: "ending" })),
    card({ id: "bath", className: "third" }, heading("Bath"), make("p", { id: "temperature", className: "huge" }, "–"), make("p", { id: "gate", className: "soft" })),
    card({ className: "half" }, heading("Temperature of the bath"), make("div", { id: "curve" }), make("p", { id: "legend", className: "soft" })),
    card({ className: "half" }, heading("What happened"), make("ol", { id: "log", className: "log", tabIndex: 0, ariaLabel: "what happened" })),
    card({ id: "seen", hidden: true }, heading("Last frames"), make("div", { id: "frames", className: "frames" })),
    card({ id: "result", hidden: true }, heading("Last trial with its truth"), make("div", { id: "scored" })),
    card({ id: "practice", hidden: true }, heading("Practice"), make("p", { className: "soft" }, "An emulated rig: this happens to it at once, as by a hand. The run is not informed."), make("ul", { id: "rig" })),
    card({ id: "health" }, heading("Instruments and interlocks"), make("ul", { id: "instruments", className: "chips" }), make("details", {}, make("summary", { id: "armed" }), make("ul", { id: "interlocks", className: "chips" }))),
  );
  controls.hidden = !under();
  chart(); events(); prompted(run.prompt); leased(); live(); practice(); ended(); trials(); queues(run, "health");
}
// an emulated rig in real time: what a hand may do to it
function practice() {
  const place = byId("practice"), now = run.practice;
  if (!place) return;
  place.hidden = !now;
  if (!now) return;
  const row = (one) => make("li", { className: "row" }, make("span", { className: "of" }, words(one.of)), make("b", { className: /^[A-Z]+$/.test(one.is) ? "bad" : "" }, one.is),
    ...Object.entries(one.words).map(([label, text]) => make("button", { className: "quiet", ariaLabel: text, onclick: () => ask(at("/practice"), { words: text }).catch((error) => problem(error.message)) }, words(label))));
  const rows = byId("rig"), state = now.choices.map((one) => JSON.stringify(one));
  while (rows.children.length > state.length) rows.lastChild.remove();
  // a row that stays is not made anew: a click that is under way would be lost
  now.choices.forEach((one, at) => {
    const old = rows.children[at];
    if (old?.dataset.state === state[at]) return;
    const made = row(one);
    made.dataset.state = state[at];
    if (old) old.replaceWith(made); else rows.append(made);
  });
}
let plot = null;
const CHART_PX = 215;
function curves() {
  const [at, celsius] = run.curve, flat = (value) => at.map(() => value), set = run.run.set_point_c, band = run.band_k;
  return [at, celsius, flat(set), flat(band ? set - band : null), flat(band ? set + band : null)];
}
function chart() {
  const place = byId("curve"), style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`);
  const axis = { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") } };
  const set = run.run.set_point_c, line = (name, more = {}) => ({ stroke: name && colour(name), points: { show: false }, ...more });
  const clock = (s) => `${Math.floor(s / 60)}:${String(Math.round(s % 60)).padStart(2, "0")}`;
  plot = new uPlot({
    width: Math.max(240, place.clientWidth), height: CHART_PX, cursor: { show: false }, legend: { show: false },
    scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(low, set - 0.5), Math.max(high, set + 0.5)] } },
    axes: [{ ...axis, label: "minutes:seconds", space: 70, incrs: [1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600], values: (_, at) => at.map(clock) }, { ...axis, label: "°C", size: 60 }],
    series: [{}, line("accent", { width: 2 }), line("good", { width: 1, dash: [6, 6] }), line(""), line("")],
    bands: [{ series: [4, 3], fill: colour("band") }],
  }, curves(), place);
  new ResizeObserver(() => plot.setSize({ width: Math.max(240, place.clientWidth), height: CHART_PX })).observe(place);
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (run && byId("curve")) { byId("curve").replaceChildren(); chart(); } });
const under = () => run.status.state === "running";
// how the run stands, as every surface says it; words are made by the bench
function stands() {
  const now = run.status, going = under();
  byId("doing").textContent = words(going ? now.step : now.word) + (now.paused ? ", a pause is asked for" : "");
  byId("step").textContent = going ? now.waiting || now.doing : now.why;
  byId("tripped").textContent = going ? now.tripped : ""; // else it is why
  byId("unsafe").replaceChildren(...now.unsafe.map((line) => make("li", { className: "big bad" }, line)));
  const then = now.next.filter((line) => line && !now.unsafe.includes(line) && !(now.asked && line.startsWith("Answer what")));
  byId("next").replaceChildren(...then.map((line) => make("li", {}, line)));
  const left = now.left_s === null ? "" : `, about ${minutes(now.left_s)} left`;
  byId("trial").textContent = words(now.trials) + (going && now.pose ? ` (${now.pose})` : "") + (going ? "" : " done") + left;
  byId("done").max = now.planned || 1;
  byId("done").value = now.done;
  byId("pause").textContent = now.paused ? "Go on" : "Pause";
  byId("pause").hidden = byId("abort").hidden = now.step === "going to safe"; // the run ends by itself
  byId("health").hidden = !now.instruments.length;
  byId("instruments").replaceChildren(...now.instruments.map((one) => make("li", { className: one.trouble ? "bad" : "" }, one.text)));
}
function live() {
  const now = run.live;
  run.band_k = now?.bath.band_k ?? run.band_k; // a run that has ended has none
  byId("legend").textContent = `Line: the bath. Dashed: its set point.${run.band_k ? " Shaded: the band." : ""}`;
  stands();
  byId("armed").parentElement.hidden = !now;
  if (!now) {
    byId("tip").hidden = byId("seen").hidden = true;
    byId("temperature").className = "huge soft";
    byId("temperature").textContent = number(run.curve[1].at(-1), "°C");
    byId("gate").textContent = run.curve[1].length ? "last reading of this run; nothing is read now" : "no reading yet";
    return;
  }
  const bath = now.bath, said = run.status.instruments.find((one) => one.name === "bath");
  byId("temperature").textContent = number(bath.temp_c, "°C");
  const steady = bath.state === "stable", old = run.status.age_s >= SILENT_S; // its bench hangs
  byId("temperature").className = said?.trouble ? "huge bad" : old ? "huge soft" : steady ? "huge good" : "huge warn";
  const why = bath.why_not_stable && !run.status.doing.includes("waiting for the bath") ? ` ${words(bath.why_not_stable)}${/[.?]$/.test(bath.why_not_stable) ? "" : "."}` : "";
  byId("gate").textContent = said?.trouble ? said.text : old ? `as it was ${minutes(run.status.age_s)} ago` : run.status.step === "going to safe" ? run.status.step : said?.safe === "at rest" ? "not heated" : `${bath.state}${["heating", "cooling"].includes(bath.state) ? " to" : " at"} ${number(bath.set_point_c, "°C", 1)} ± ${number(bath.band_k, "K")}` + (steady ? "" : `; stable in about ${minutes(bath.stable_in_s)}.${why}`);
  if (plot && bath.t_s !== null && bath.t_s > (run.curve[0].at(-1) ?? -1)) {
    run.curve[0].push(bath.t_s); run.curve[1].push(bath.temp_c);
    if (run.curve[0].length > 1200) run.curve = run.curve.map((one) => one.filter((_, k) => k % 2 === 0));
    plot.setData(curves());
  }
  byId("interlocks").replaceChildren(...now.interlocks.map((one) => make("li", { className: one.state === "tripped" ? "bad" : "" }, `${one.name}: ${one.state}`)));
  const count = (state) => now.interlocks.filter((one) => one.state === state).length;
  byId("armed").textContent = `${count("armed")} of ${now.interlocks.length} interlocks armed${count("asleep") ? `, ${count("asleep")} need what this bath doesn't tell` : ""}`;
  tip(now);
  if (now.frames && now.frames !== run.framesShown) { run.framesShown = now.frames; frames(); }
}
const trialsOf = (n) => `${n ?? "?"} ${n === 1 ? "trial" : "trials"}`;
const words = (text) => text.charAt(0).toUpperCase() + text.slice(1);
const ROUND_MM = 45; // what the plan shows around the teats
function tip(now) {
  const place = byId("tip");
  place.hidden = !now.tip;
  if (!now.tip) return;
  const asked = now.ends.find((end) => run.prompt?.text.includes(end.name));
  const wrong = asked && now.tip.nearest && asked.name !== now.tip.nearest;
  const near = now.tip.nearest ? [make("p", { className: "huge" }, `${now.tip.away_mm.toFixed(0)} mm`), make("p", { className: wrong ? "big warn" : "big" }, `off ${now.tip.nearest}`)] : [];
  if (wrong) near.push(make("p", { className: "soft" }, `asked for: ${asked.name}`));
  const ends = now.ends.map((end) => end.mm), all = ends.length ? ends : [now.tip.mm];
  const edge = (k, most, sign) => most(...all.map((mm) => mm[k])) + sign * ROUND_MM;
  const [left, right, bottom, top] = [edge(0, Math.min, -1), edge(0, Math.max, 1), edge(1, Math.min, -1), edge(1, Math.max, 1)];
  const plan = draw("svg", { viewBox: `${left} ${-top} ${right - left} ${top - bottom}`, role: "img", "aria-label": "teat ends and tip from above, cameras below" });
  for (const end of now.ends) {
    const [x, y] = [end.mm[0], -end.mm[1]], short = end.name.match(/\((\w+)\)/)?.[1] || end.name.match(/\d+/)?.[0] || "";
    plan.append(draw("circle", { cx: x, cy: y, r: 9, class: end === asked ? "end asked" : "end" }), draw("text", { x, y: y - 13, class: "name" }, short));
  }
  const held = (value, low, high) => Math.min(Math.max(value, low + 7), high - 7);
  const [x, y] = [held(now.tip.mm[0], left, right), -held(now.tip.mm[1], bottom, top)];
  const inside = x === now.tip.mm[0] && y === -now.tip.mm[1]; // else it is shown at the edge, hollow
  plan.append(draw("circle", { cx: x, cy: y, r: 5, class: inside ? "tip" : "tip far" }));
  place.replaceChildren(make("div", {}, heading("The tip"), ...near), plan);
}
async function frames() {
  byId("seen").hidden = false;
  const shown = [];
  for (const camera of Object.keys(SHOWN)) {
    const src = await picture(at(`/live/${camera}`));
    if (src) shown.push(make("figure", {}, make("img", { src, alt: `${SHOWN[camera]}, last frame`, onload() { URL.revokeObjectURL(src); } }), make("figcaption", {}, SHOWN[camera])));
  }
  if (shown.length) byId("frames").replaceChildren(...shown);
}
async function trials() {
  const found = await ask(at("/trials")).catch(() => null);
  const last = found?.trials.at(-1);
  if (!last || last.id === run.lastTrial) return;
  run.lastTrial = last.id;
  const names = Object.keys(last.scores), who = (of) => last.places[of] || 1, tone = (of) => TONES[(who(of) - 1) % 4];
  const scores = names.map((name) => {
    const one = last.scores[name];
    return make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, `${one.found} of ${one.visible} found`), make("td", {}, `${one.false} false`), make("td", {}, one.max_error_mm === null ? "–" : `at most ${one.max_error_mm.toFixed(2)} mm off`));
  });
  const views = [];
  for (const camera of last.cameras) {
    const src = await picture(at(`/trials/${encodeURIComponent(last.id)}/${camera}`));
    if (!src) continue;
    const image = new Image();
    image.src = src;
    await image.decode().catch(() => null);
    const [w, h] = [image.naturalWidth, image.naturalHeight];
    const [x0, y0, wide] = cut(last, camera, w, h), r = wide / 45;
    const view = draw("svg", { viewBox: `${x0} ${y0} ${wide} ${(wide * 3) / 4}`, role: "img", "aria-label": `${SHOWN[camera]} with truth and answers` });
    view.append(draw("image", { href: src, width: w, height: h }));
    (last.px[camera] || []).forEach(([across, y], k) => {
      const x = last.mirrored.includes(camera) ? w - 1 - across : across;
      const mark = last.marks[k];
      if (mark.of === "truth") view.append(draw("circle", { cx: x, cy: y, r, fill: "none", stroke: TRUTH, "stroke-width": r / 4 }));
      else view.append(draw("path", { d: marked(who(mark.of), x, y, r), fill: "none", stroke: tone(mark.of), "stroke-width": r / 4 }));
    });
    views.push(make("figure", {}, view, make("figcaption", {}, SHOWN[camera])));
  }
  const key = (mark, colour, text) => { const shown = make("b", {}, mark); shown.style.color = colour; return make("span", {}, shown, ` ${text}`); };
  byId("result").hidden = false;
  byId("scored").replaceChildren(make("p", { className: "big" }, `${last.name} (${last.situation})`), make("div", { className: "scroll" }, make("table", {}, make("tbody", {}, ...scores))), make("div", { className: "frames" }, ...views), make("p", { className: "key" }, key("◯", TRUTH, "truth"), ...names.map((name) => key(MARKS[form(who(name))], tone(name), name))));
}
// the part of a picture round the teats, 4:3: left, top and width
function cut(trial, camera, w, h) {
  const seen = (trial.px[camera] || []).filter((_, k) => trial.marks[k].of === "truth");
  if (!seen.length || camera === "thermal") return [0, 0, w];
  const xs = seen.map(([x]) => (trial.mirrored.includes(camera) ? w - 1 - x : x)), ys = seen.map(([, y]) => y);
  const span = Math.max(Math.max(...xs) - Math.min(...xs), (Math.max(...ys) - Math.min(...ys)) * 4 / 3);
  const wide = Math.min(w, (h * 4) / 3, span * 1.5 + w / 8);
  const middle = (all, size, most) => Math.max(0, Math.min(most - size, (Math.min(...all) + Math.max(...all)) / 2 - size / 2));
  return [middle(xs, wide, w), middle(ys, (wide * 3) / 4, h), wide];
}
function events() {
  const states = run.events.filter((one) => one.kind === "run state").map((one) => one.text); // each is also told as what is done
  const lines = run.events.filter((one) => ["event", "warning"].includes(one.what) && !(one.kind === "state" && states.includes(one.text))).reverse();
  if (!lines.length) { byId("log").replaceChildren(make("li", {}, under() ? "nothing yet" : "nothing was kept")); return; }
  byId("log").replaceChildren(...lines.map((one) => make("li", { className: one.what === "warning" || BAD.includes(one.kind) ? "bad" : "" }, `${one.wall_time.slice(11, 19)} ${one.kind ? one.kind + ": " : ""}${one.text}`)));
}
const resumed = (name) => started(ask(`/runs/${encodeURIComponent(name)}/resume`, {}));
const verdicts = (status) => Object.entries(status.verdicts).map(([name, verdict]) => make("li", { className: { met: "good", "not met": "bad" }[verdict] || "warn" }, `${name}: ${verdict}`));
const resumable = (known) => known.status.state !== "running" && known.status.next.some((line) => line.includes("teatbench resume "));
function ended() {
  const known = { ...run.run, status: run.status };
  controls.hidden = !under();
  if (under()) { byId("ending").replaceChildren(); return; }
  byId("ending").replaceChildren(
    make("ul", { className: "chips large" }, ...verdicts(known.status)),
    make("p", { className: "row" }, known.report ? make("button", { onclick: () => report_of(run.name) }, "Open the report") : null, resumable(known) ? make("button", { className: "quiet", onclick: () => resumed(run.name) }, "Resume this run") : null));
}
async function report_of(name) {
  const tab = window.open("", "_blank");
  try {
    const { url } = await ask(`/runs/${encodeURIComponent(name)}/report`, {});
    if (tab) { tab.opener = null; tab.location = url; } else location.assign(url);
  } catch (error) { tab?.close(); problem(error.message); }
}
function problem(text) {
  const place = byId("problem");
  if (place) { place.hidden = !text; place.textContent = text; }
}

// ---- prompts ----
const REASONS = ["a teat came off", "the set-up can't be made", "an instrument is at fault"];
async function prompted(prompt) {
  const place = byId("ask");
  if (!place) return;
  if (!prompt) { place.hidden = true; place.replaceChildren(); run.asked = 0; return; }
  if (run.asked === prompt.number) return;
  run.asked = prompt.number;
  place.hidden = false;
  const answer = async (given) => {
    for (const button of place.querySelectorAll("button")) button.disabled = true;
    problem("");
    try {
      await ask(at(`/answers/${prompt.number}`), { words: given, name: NAME });
    } catch (error) {
      problem(error.message);
      for (const button of place.querySelectorAll("button")) button.disabled = false;
    }
  };
  const text = prompt.text.split("\n").filter((line) => !line.startsWith("Picture: "));
  const detail = text.findIndex((line) => line.startsWith("On the plate"));
  const said_big = text.slice(0, detail < 0 ? undefined : detail), said_small = detail < 0 ? [] : text.slice(detail);
  const called = (k) => prompt.text.match(new RegExp(`teat ${k}(, [^:\n]{1,40}?\\(\\w+\\))?`))?.[0] || `teat ${k}`;
  const hidden = [...Array(prompt.hidden_to).keys()].map((k) => make("label", { className: "choice" }, make("input", { type: "checkbox", value: String(k + 1) }), called(k + 1)));
  const chosen = () => hidden.map((one) => one.firstChild).filter((box) => box.checked).map((box) => box.value).join(" ");
  const typed = prompt.kind === "coordinates" ? make("input", { type: "text", id: "point", placeholder: "x y z", ariaLabel: "x, y and z of the point", maxLength: 80 }) : null;
  const given = () => (typed ? typed.value : chosen() ? `hidden ${chosen()}` : "go");
  const buttons = [...(typed ? [typed] : []), make("button", { className: "done", id: "answer-done", onclick: () => answer(given()) }, "Done")];
  let skipping = null;
  if (prompt.in_trial) {
    const why = make("input", { type: "text", id: "why", placeholder: "another reason", ariaLabel: "why the trial is skipped", maxLength: 200 });
    const skip = () => (why.value.trim() ? answer(`skip ${why.value}`) : (problem("A skipped trial needs a reason, for the record."), why.focus()));
    skipping = make("p", { className: "row", id: "skipping", hidden: true }, ...REASONS.map((reason) => make("button", { className: "quiet", onclick: () => answer(`skip ${reason}`) }, words(reason))), why, make("button", { className: "quiet", id: "answer-skip", onclick: skip }, "Skip for this reason"));
    const open = make("button", { className: "quiet", id: "skip", ariaExpanded: "false", onclick: () => { skipping.hidden = !skipping.hidden; open.ariaExpanded = String(!skipping.hidden); } }, "Skip the trial …");
    buttons.push(make("button", { className: "quiet", id: "answer-repeat", onclick: () => answer("repeat") }, "Repeat the trial"), open);
  }
  if (prompt.enough) buttons.push(make("button", { className: "quiet", onclick: () => answer("enough") }, "Enough"));
  place.replaceChildren(
    make("div", { className: "words" },
      make("p", { className: "soft" }, prompt.progress), make("p", { className: "what" }, said_big.join("\n")),
      ...(said_small.length ? [make("details", { open: innerWidth >= 600 }, make("summary", {}, said_small[0]), make("p", { className: "coordinates" }, said_small.slice(1).join("\n")))] : []),
      ...(hidden.length ? [make("p", {}, "Tick the teat ends that a camera can't see:"), make("p", { className: "row" }, ...hidden)] : []),
      make("p", { className: "row answers" }, ...buttons), skipping,
      make("details", {}, make("summary", {}, "What does each answer do?"), make("pre", {}, prompt.explained))),
    make("div", { className: "view" }),
  );
  leased();
  sounded();
  if (prompt.picture) {
    const src = await picture(at("/set-up"));
    if (src && run.asked === prompt.number) place.querySelector(".view").replaceChildren(make("img", { src, alt: "what to set up: the plate from above, and as the left camera will see it" }));
  }
}
function leased() {
  const mine = !run.lease?.name || run.lease.mine;
  byId("lease").className = mine ? "mine" : "";
  byId("lease").replaceChildren(run.lease?.name ? (mine ? "You answer the prompts." : `${words(run.lease.name)} answers the prompts. `) : "");
  if (!mine) byId("lease").append(make("button", { className: "quiet", id: "take", onclick: () => ask("/lease", { name: NAME }).then((lease) => { run.lease = lease; leased(); }) }, "Take over"));
  for (const button of document.querySelectorAll("#ask button, #pause")) button.disabled = !mine;
}
function sounded() {
  if (!beep.on) return;
  beep.context ||= new AudioContext();
  const tone = beep.context.createOscillator(), gain = beep.context.createGain();
  gain.gain.value = 0.2;
  tone.connect(gain).connect(beep.context.destination);
  tone.frequency.value = 740;
  tone.start();
  tone.stop(beep.context.currentTime + 0.25);
}
const controlled = (given) => ask(at("/control"), { words: given, name: NAME }).catch((error) => problem(error.message));
byId("pause").onclick = () => controlled(run.status?.paused ? "go on" : "pause");
byId("abort").onclick = () => { byId("abort").textContent = "Aborting"; controlled("abort").then(() => setTimeout(() => { byId("abort").textContent = "Abort"; }, 4000)); };
byId("sound").onclick = () => { beep.on = !beep.on; byId("sound").textContent = beep.on ? "Sound on" : "Sound off"; byId("sound").ariaPressed = String(beep.on); sounded(); };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || ["INPUT", "BUTTON", "SELECT", "A", "SUMMARY"].includes(event.target.tagName)) return;
  const id = { Enter: "answer-done", r: "answer-repeat", a: "abort" }[event.key];
  if (id && byId(id)?.offsetParent !== null) { event.preventDefault(); byId(id)?.click(); }
});

// ---- all runs, and a new one ----
async function home() {
  byId("title").textContent = "";
  controls.hidden = true;
  main.replaceChildren(make("section", { id: "problem", className: "card bad", hidden: true, role: "alert" }), make("section", { className: "card", id: "new" }, make("h2", {}, "Start a run")), make("section", { className: "card", id: "list" }, make("h2", {}, "Runs")));
  try {
    const [{ runs }, known] = await Promise.all([ask("/runs"), ask("/choices")]);
    showStatus("connected");
    const now = runs.find((one) => one.status.state === "running");
    if (now && hint === "now") { hintUsed(now.name); return; }
    starter(known);
    queues(null, "list");
    showRuns(runs);
  } catch (error) {
    showStatus("no connection to the console", true);
    problem(error.message);
  }
}
// the list as it is now, looked at again while it is shown
let relist = 0;
function showRuns(runs, before = "") {
  const now = JSON.stringify(runs.map(({ name, status }) => [name, status.headline, status.unsafe, status.verdicts]));
  const list = byId("list");
  if (!list) return;
  if (now !== before) list.replaceChildren(list.firstElementChild, ...(runs.length ? runs.map(listed) : [make("p", {}, "No runs yet.")]));
  clearTimeout(relist);
  relist = setTimeout(async () => {
    try { const found = await ask("/runs"); if (!run) { showStatus("connected"); showRuns(found.runs, now); } } catch (error) { if (!run) { showStatus("no connection to the console", true); showRuns(runs, now); } }
  }, QUEUE_MS);
}
function hintUsed(name) { location.hash = `#/${encodeURIComponent(name)}`; }
function listed(one) {
  const place = make("div", { className: "thumbnails" });
  if (one.status.done) shown.observe(Object.assign(place, { run: one.name }));
  return make("article", { className: "run" },
    make("div", { className: "about" },
      make("h3", {}, make("a", { href: `#/${encodeURIComponent(one.name)}` }, one.name)),
      make("p", { className: "soft" }, `${one.title}; on ${one.rig || "a recording"}`),
      make("p", { className: one.status.state === "running" && !one.status.unsafe.length ? "good" : "" }, one.status.headline),
      ...[...one.status.unsafe, one.status.damage.length ? one.status.why : ""].filter(Boolean).map((line) => make("p", { className: "bad" }, line)),
      make("ul", { className: "chips" }, ...verdicts(one.status))),
    place,
    make("p", { className: "row" },
      one.report ? make("button", { className: "quiet", ariaLabel: `Report of ${one.name}`, onclick: () => report_of(one.name) }, "Report") : null,
      resumable(one) ? make("button", { className: "quiet", ariaLabel: `Resume ${one.name}`, onclick: () => resumed(one.name) }, "Resume") : null));
}
// thumbnails are asked for when they come into sight: a folder may have hundreds of runs
const shown = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    shown.unobserve(target);
    ask(`/runs/${encodeURIComponent(target.run)}/thumbnails`).then(({ thumbnails }) => target.append(...thumbnails.map(([alt, data]) => make("img", { src: `data:image/jpeg;base64,${data}`, alt })))).catch(() => null);
  }
});
// the last queue of scripts, kept up to date on both pages: what has run, what runs and what
// follows; a page that saw one run to its end goes on to the next
const QUEUE_MS = 2000;
let again = 0;
async function queues(mine, before) {
  clearTimeout(again);
  const { queue: known } = await ask("/queue").catch(() => ({}));
  if (mine !== run || !byId(before)) return;
  const here = known && (!mine || known.scripts.some((one) => one.run === mine.name)) ? queue(known) : null;
  const there = byId("queue");
  if (!here) there?.remove();
  else if (!there) main.insertBefore(here, byId(before));
  else if (there.textContent !== here.textContent) there.replaceWith(here);
  if (mine && known) {
    const now = known.scripts.findLast((one) => one.run)?.run;
    if (under()) mine.seenUnderWay = true;
    else if (here && known.under_way && mine.seenUnderWay && now !== mine.name) { hintUsed(now); return; }
  }
  again = setTimeout(() => queues(mine, before), QUEUE_MS);
}
function queue(known) {
  const row = (one, at) => make("li", {}, make("b", {}, `${at + 1}. ${one.script}`), " ", one.run ? make("a", { href: `#/${encodeURIComponent(one.run)}` }, one.text) : make("span", { className: "soft" }, one.text));
  return card({ id: "queue" }, heading(known.under_way ? "Queue, running" : "Last queue"), make("p", { className: known.under_way ? "good" : "" }, words(known.headline)), make("ol", { className: "next" }, ...known.scripts.map(row)));
}
const SPEEDS = { "in real time": 1, "ten times as fast, to practise": 10, "as fast as they can": 0 };
function starter(known) {
  const choice = (label, names, first) => {
    const select = make("select", { ariaLabel: label }, ...names.map((name) => make("option", { value: name, selected: name === first }, name)));
    return [make("label", { className: "above" }, label, select), select];
  };
  const [rigLabel, rig] = choice("Rig", known.rigs, "emulated-browser"), [scriptLabel, script] = choice("Script", known.scripts, "six-situations");
  const boxes = known.detectors.map((name) => make("input", { type: "checkbox", value: name, checked: name === "fused" }));
  const more = [], queued = make("button", { className: "quiet", id: "then", onclick: () => {
    const [label, select] = choice("Then", known.scripts, script.value);
    more.push(select);
    queued.before(label);
  } }, "Add a script after it");
  const scripts = () => [script, ...more].map((one) => one.value);
  const [speedLabel, speed] = choice("Speed of emulated rigs", Object.keys(SPEEDS), "in real time");
  const chosen = () => ({ rig: rig.value, scripts: scripts(), detectors: boxes.filter((box) => box.checked).map((box) => box.value), speed: speed.disabled ? 0 : SPEEDS[speed.value] });
  rig.onchange = () => { speed.disabled = !known.paced.includes(rig.value); };
  const result = make("div", { id: "dry", role: "status" });
  const tried = make("button", { className: "quiet", id: "try", onclick: async () => {
    tried.disabled = true; problem(""); result.replaceChildren("Going through the script on emulators: this takes a while.");
    try {
      const shown = [];
      for (const name of scripts()) {
        const place = make("div"), found = await ask("/dry-run", { ...chosen(), scripts: [name] });
        dried(place, found);
        shown.push(...(more.length ? [make("h3", {}, name)] : []), place);
      }
      result.replaceChildren(...shown);
    } catch (error) { result.replaceChildren(); problem(error.message); }
    tried.disabled = false;
  } }, "Dry run");
  const go = make("button", { id: "start", onclick: async () => { go.disabled = true; await started(ask("/start", chosen())); go.disabled = false; } }, "Start");
  byId("new").append(make("p", { className: "row" }, rigLabel, speedLabel), make("p", { className: "row" }, scriptLabel, queued),
    make("fieldset", {}, make("legend", {}, "Detectors"), ...boxes.map((box) => make("label", { className: "choice" }, box, box.value))),
    make("p", { className: "row" }, tried, go), result);
}
// what a dry run found: each finding under its trial
function dried(place, { exit_code, text, found }) {
  if (!found) { place.replaceChildren(make("p", { className: "bad" }, exit_code ? "It can't be run:" : ""), make("pre", {}, text)); return; }
  const by = Map.groupBy(found.findings, (one) => one.trial), count = found.findings.length;
  const rows = [...by].map(([trial, of]) => make("tr", {}, make("th", { scope: "row" }, trial), make("td", {}, make("ul", {}, ...of.map((one) => make("li", {}, `${words(one.kind)}: ${one.text}`))))));
  place.replaceChildren(
    make("p", { className: count ? "big bad" : "big good" }, count ? `${count} problem${count > 1 ? "s" : ""}` : "Nothing wrong was found"),
    make("p", { className: "soft" }, `${found.gone_through} of ${trialsOf(found.trials)} gone through on emulators. Nothing was moved.`),
    ...(rows.length ? [make("div", { className: "scroll" }, make("table", {}, make("tbody", {}, ...rows)))] : []),
    make("ul", {}, ...[...found.not_checked.map((what) => `Not checked: ${what}`), ...found.needs.map(words)].map((line) => make("li", {}, line))));
}
async function started(asked) {
  problem("");
  try { const found = await asked; if (location.hash === `#/${encodeURIComponent(found.run)}`) routed(); else hintUsed(found.run); } catch (error) { problem(error.message); }
}
function routed() {
  if (/^#[^/]/.test(location.hash)) { location.reload(); return; }  // the address with its token, opened again
  stop.abort();
  const name = decodeURIComponent(location.hash.slice(2));
  if (name && name !== "now") { run = { name, events: [], curve: [[], []], prompt: null }; main.replaceChildren(make("p", {}, "Looking at the run.")); follow(name); } else { run = null; home(); }
}
window.addEventListener("hashchange", routed);
routed();
