// The page: a list of runs, or one run that it follows. All state comes from the server; text is
// only ever set as text.

const [token, hint] = location.hash.slice(1).split("#");
if (token && !token.startsWith("/")) {
  sessionStorage.setItem("token", token);
  history.replaceState(null, "", "#/" + (hint || ""));
}
const TOKEN = sessionStorage.getItem("token") || "";
const CLIENT = sessionStorage.getItem("client") || crypto.randomUUID();
sessionStorage.setItem("client", CLIENT);
const NAME = /Mobi|Android/.test(navigator.userAgent) ? "a telephone or tablet" : "a computer's browser";
const RETRY_MS = 1000, EVENTS = 40, TONES = ["#2fbf71", "#e5533d", "#3d8fe5", "#c678dd", "#e5a13d"];
const SHOWN = { left: "left camera", right: "right camera", thermal: "thermal camera" };
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
async function ask(path, body) {
  const options = body === undefined
    ? { headers: headers() }
    : { method: "POST", headers: headers({ "Content-Type": "application/json" }), body: JSON.stringify(body) };
  const answer = await fetch(`/api${path}`, options);
  const found = await answer.json().catch(() => ({ error: answer.statusText }));
  if (!answer.ok) throw Object.assign(new Error(found.error), { status: answer.status });
  return found;
}
async function picture(path) {
  const answer = await fetch(`/api${path}`, { headers: headers() });
  return answer.ok ? URL.createObjectURL(await answer.blob()) : null;
}
function minutes(seconds) {
  if (seconds === null || seconds === undefined) return "";
  return seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`;
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
        said((await answer.json()).error || answer.statusText, true);
        if (answer.status === 404 || answer.status === 401) return;
        throw new Error(answer.statusText);
      }
      said("connected");
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
          if (fields.event) heard(fields.event, JSON.parse(fields.data));
        }
      }
    } catch (error) {
      if (mine.signal.aborted) return;
    }
    said("no connection to the console: trying again. The run goes on.", true);
    await new Promise((then) => setTimeout(then, RETRY_MS));
  }
}
// a connection that says nothing for long is a dead one: the server sends a comment every 10 s
function quickly(promise) {
  return Promise.race([promise, new Promise((_, fail) => setTimeout(() => fail(new Error("silence")), 25000))]);
}
function said(text, lost = false) {
  byId("connection").textContent = text;
  byId("connection").classList.toggle("lost", lost);
}
function heard(kind, value) {
  if (kind === "snapshot") {
    const asked = run.prompt;
    Object.assign(run, value, { name: run.name });
    page();
    if (asked && value.prompt && asked.number === value.prompt.number) prompted(value.prompt);
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
    if (kind === "live") live();
    if (kind === "prompt") prompted(value);
    if (kind === "lease") leased();
  }
}
// the report comes some seconds after the run's end
async function refreshed(tries = 40) {
  const mine = run, found = await ask(at("")).catch(() => null);
  if (run !== mine) return;
  if (found) { run.run = found.run; ended(); trials(); }
  if (tries && !run.run.report) setTimeout(() => run === mine && refreshed(tries - 1), 1500);
}
const at = (path) => `/runs/${encodeURIComponent(run.name)}${path}`;

function page() {
  byId("title").textContent = run.run.title;
  main.replaceChildren(
    make("section", { id: "ask", className: "card", hidden: true, "aria-live": "assertive" }),
    make("section", { id: "problem", className: "card bad", hidden: true, role: "alert" }),
    make("section", { id: "tip", className: "card", hidden: true }),
    make("section", { className: "card wide" }, make("p", { id: "doing", className: "big" }), make("p", { id: "trial", className: "soft" }), make("progress", { id: "done", max: 1, value: 0, "aria-label": "trials done" }), make("div", { id: "ending" })),
    make("section", { id: "bath", className: "card third" }, make("h2", {}, "Bath"), make("p", { id: "temperature", className: "huge" }, "–"), make("p", { id: "gate", className: "soft" })),
    make("section", { className: "card half" }, make("h2", {}, "Temperature of the bath"), make("div", { id: "curve" })),
    make("section", { className: "card half" }, make("h2", {}, "What happened"), make("ol", { id: "log", className: "log", tabIndex: 0, ariaLabel: "what happened" })),
        make("section", { id: "seen", className: "card", hidden: true }, make("h2", {}, "Last frames"), make("div", { id: "frames", className: "frames" })),
    make("section", { id: "result", className: "card", hidden: true }, make("h2", {}, "Last trial with its truth"), make("div", { id: "scored" })),
    make("section", { className: "card" }, make("h2", {}, "Instruments and interlocks"), make("ul", { id: "instruments", className: "chips" }), make("p", { id: "tripped", className: "big bad" }), make("details", {}, make("summary", { id: "armed" }), make("ul", { id: "interlocks", className: "chips" }))),
  );
  controls.hidden = run.run.ending !== "under way";
  chart(); events(); prompted(run.prompt); leased(); live(); ended(); trials();
}
let plot = null;
function chart() {
  const place = byId("curve"), style = getComputedStyle(document.documentElement);
  const soft = style.getPropertyValue("--soft"), line = style.getPropertyValue("--line");
  const axis = { stroke: soft, grid: { stroke: line, width: 1 }, ticks: { stroke: line } };
  const set = run.run.set_point_c;
  plot = new uPlot({
    width: Math.max(240, place.clientWidth), height: 215, cursor: { show: false },
    scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(low, set - 0.5), Math.max(high, set + 0.5)] } },
    axes: [{ ...axis, label: "minutes", values: (_, at) => at.map((s) => +(s / 60).toFixed(1)) }, { ...axis, label: "°C", size: 60 }],
    series: [{}, { stroke: style.getPropertyValue("--accent"), width: 2, points: { show: false } }, { stroke: style.getPropertyValue("--good"), width: 1, dash: [6, 6], points: { show: false } }],
  }, [run.curve[0], run.curve[1], run.curve[0].map(() => set)], place);
  new ResizeObserver(() => plot.setSize({ width: Math.max(240, place.clientWidth), height: 215 })).observe(place);
}
function live() {
  const now = run.live;
  const under = run.run.ending === "under way";
  byId("doing").textContent = now ? words(now.state) + (now.paused ? ", a pause is asked for" : "") : under ? "waiting for the run to say how it is" : words(run.run.ending);
  if (!now) { byId("tip").hidden = byId("seen").hidden = true; return; }
  const left = now.left_s === null ? "" : `, about ${minutes(now.left_s)} left`;
  byId("trial").textContent = `${now.done} of ${now.planned} trials done${left}${now.pose ? `; now: ${now.pose}` : ""}`;
  byId("done").max = now.planned || 1;
  byId("done").value = now.done;
  byId("pause").textContent = now.paused ? "Go on" : "Pause";
  const bath = now.bath;
  byId("temperature").textContent = number(bath.temp_c, "°C");
  const steady = bath.state === "stable";
  byId("temperature").className = steady ? "huge good" : "huge warn";
  byId("gate").textContent = `${steady ? "stable" : words(bath.state)} at ${number(bath.set_point_c, "°C", 1)} ± ${number(bath.band_k, "K")}` + (steady ? "" : `; stable in about ${minutes(bath.stable_in_s)}. ${bath.why_not_stable}`);
  if (plot && bath.t_s !== null && bath.t_s > (run.curve[0].at(-1) ?? -1)) {
    run.curve[0].push(bath.t_s); run.curve[1].push(bath.temp_c);
    if (run.curve[0].length > 1200) run.curve = run.curve.map((one) => one.filter((_, k) => k % 2 === 0));
    plot.setData([run.curve[0], run.curve[1], run.curve[0].map(() => bath.set_point_c)]);
  }
  byId("instruments").replaceChildren(...Object.entries(now.instruments).map(([name, health]) => make("li", { className: health === "ok" ? "" : "bad" }, `${name}: ${health}`)));
  byId("interlocks").replaceChildren(...now.interlocks.map((one) => make("li", { className: one.state === "tripped" ? "bad" : "" }, `${one.name}: ${one.state}`)));
  byId("tripped").textContent = now.tripped || "";
  const count = (state) => now.interlocks.filter((one) => one.state === state).length;
  byId("armed").textContent = `${count("armed")} of ${now.interlocks.length} interlocks armed${count("asleep") ? `, ${count("asleep")} need what this bath doesn't tell` : ""}`;
  tip(now);
  if (now.frames && now.frames !== run.framesShown) { run.framesShown = now.frames; frames(); }
}
const words = (text) => text.charAt(0).toUpperCase() + text.slice(1);
function tip(now) {
  const place = byId("tip");
  place.hidden = !now.tip;
  if (!now.tip) return;
  const near = now.tip.nearest ? [make("p", { className: "huge" }, `${now.tip.away_mm.toFixed(0)} mm`), make("p", { className: "big" }, `off ${now.tip.nearest}`)] : [];
  const all = [...now.ends.map((end) => end.mm), now.tip.mm];
  const [low, high] = [0, 1].map((k) => [Math.min(...all.map((p) => p[k])) - 25, Math.max(...all.map((p) => p[k])) + 25]);
  const plan = draw("svg", { viewBox: `${low[0]} ${-high[1]} ${low[1] - low[0]} ${high[1] - high[0]}`, role: "img", "aria-label": "teat ends and tip from above" });
  for (const end of now.ends) plan.append(draw("circle", { cx: end.mm[0], cy: -end.mm[1], r: 7, fill: "none", stroke: "currentColor", "stroke-width": 1.5 }));
  plan.append(draw("circle", { cx: now.tip.mm[0], cy: -now.tip.mm[1], r: 4, fill: "var(--bad)" }));
  place.replaceChildren(make("div", {}, make("h2", {}, "The tip"), ...near), plan);
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
  const names = Object.keys(last.scores), tone = (of) => TONES[1 + names.indexOf(of)] || TONES[1];
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
    const [w, h] = [image.naturalWidth, image.naturalHeight], r = w / 60;
    const view = draw("svg", { viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": `${SHOWN[camera]} with truth and answers` });
    view.append(draw("image", { href: src, width: w, height: h }));
    (last.px[camera] || []).forEach(([across, y], k) => {
      const x = last.mirrored.includes(camera) ? w - 1 - across : across;
      const mark = last.marks[k];
      if (mark.of === "truth") view.append(draw("circle", { cx: x, cy: y, r, fill: "none", stroke: TONES[0], "stroke-width": r / 4 }));
      else view.append(draw("path", { d: `M${x - r} ${y}h${2 * r}M${x} ${y - r}v${2 * r}`, stroke: tone(mark.of), "stroke-width": r / 4 }));
    });
    views.push(make("figure", {}, view, make("figcaption", {}, SHOWN[camera])));
  }
  byId("result").hidden = false;
  byId("scored").replaceChildren(make("p", { className: "big" }, `${last.name} (${last.situation})`), make("div", { className: "scroll" }, make("table", {}, make("tbody", {}, ...scores))), make("div", { className: "frames" }, ...views), make("p", { className: "soft" }, `Circles: truth. Crosses: ${names.join(", ")}.`));
}
function events() {
  const lines = run.events.filter((one) => ["event", "warning"].includes(one.what)).reverse();
  byId("log").replaceChildren(...lines.map((one) => make("li", { className: one.what === "warning" ? "bad" : "" }, `${one.wall_time.slice(11, 19)} ${one.kind ? one.kind + ": " : ""}${one.text}`)));
}
function ended() {
  const known = run.run, under = known.ending === "under way";
  controls.hidden = !under;
  const verdicts = Object.entries(known.verdicts).map(([name, verdict]) => make("p", { className: "big" }, `${name}: ${verdict}`));
  const report = known.report ? make("button", { onclick: () => report_of(run.name) }, "Open the report") : null;
  const again = !under && known.ending !== "finished" ? make("button", { className: "quiet", onclick: () => started(ask(at("/resume"), {})) }, "Resume this run") : null;
  byId("ending").replaceChildren(...(under ? [] : [...verdicts, make("p", { className: "row" }, report, again)]));
  if (!under) { byId("trial").textContent = `${known.done} of ${known.planned ?? "?"} trials done`; byId("done").max = known.planned || 1; byId("done").value = known.done; if (!run.live) byId("doing").textContent = words(known.ending); }
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
  const hidden = [...Array(prompt.hidden_to).keys()].map((k) => make("label", {}, make("input", { type: "checkbox", value: String(k + 1) }), `teat ${k + 1}`));
  const chosen = () => hidden.map((one) => one.firstChild).filter((box) => box.checked).map((box) => box.value).join(" ");
  const why = make("input", { type: "text", id: "why", placeholder: "why?", ariaLabel: "why the trial is skipped", maxLength: 200 });
  const skip = () => (why.value.trim() ? answer(`skip ${why.value}`) : (problem("A skipped trial needs a reason, for the record."), why.focus()));
  const buttons = [make("button", { className: "done", id: "answer-done", onclick: () => answer(chosen() ? `hidden ${chosen()}` : "go") }, "Done")];
  if (prompt.in_trial) buttons.push(make("button", { className: "quiet", id: "answer-repeat", onclick: () => answer("repeat") }, "Repeat the trial"), make("span", { className: "row" }, why, make("button", { className: "quiet", id: "answer-skip", onclick: skip }, "Skip the trial")));
  if (prompt.enough) buttons.push(make("button", { className: "quiet", onclick: () => answer("enough") }, "Enough"));
  const text = prompt.text.split("\n").filter((line) => !line.startsWith("Picture: ")).join("\n");
  place.replaceChildren(
    make("p", { className: "soft" }, prompt.progress), make("p", { className: "what" }, text),
    ...(hidden.length ? [make("p", { className: "soft" }, "Teat ends that a camera can't see:"), make("p", { className: "row" }, ...hidden)] : []),
    make("p", { className: "row" }, ...buttons),
    make("div", { className: "view" }),
    make("details", {}, make("summary", {}, "What does each answer do?"), make("pre", {}, prompt.explained)),
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
byId("pause").onclick = () => controlled(run.live?.paused ? "go on" : "pause");
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
  main.replaceChildren(make("section", { id: "problem", className: "card bad", hidden: true, role: "alert" }), make("section", { className: "card", id: "new" }, make("h2", {}, "Start a run")), make("section", { className: "card scroll", id: "list" }, make("h2", {}, "Runs")));
  try {
    const [{ runs }, known] = await Promise.all([ask("/runs"), ask("/choices")]);
    said("connected");
    const now = runs.find((one) => one.ending === "under way");
    if (now && hint === "now") { hintUsed(now.name); return; }
    starter(known);
    const rows = runs.map((one) => make("tr", {},
      make("td", {}, make("a", { href: `#/${encodeURIComponent(one.name)}` }, one.name)),
      make("td", { className: one.ending === "under way" ? "good" : "" }, one.ending),
      make("td", {}, `${one.done} of ${one.planned ?? "?"}`),
      make("td", {}, Object.entries(one.verdicts).map(([name, verdict]) => `${name}: ${verdict}`).join(", ") || one.detectors.join(", ")),
      make("td", {}, one.report ? make("button", { className: "quiet", onclick: () => report_of(one.name) }, "Report") : "")));
    byId("list").append(rows.length ? make("table", {}, make("thead", {}, make("tr", {}, ...["run", "ended", "trials", "verdict", ""].map((text) => make("th", { scope: "col" }, text)))), make("tbody", {}, ...rows)) : make("p", {}, "No runs yet."));
  } catch (error) {
    said("no connection to the console", true);
    problem(error.message);
  }
}
function hintUsed(name) { location.hash = `#/${encodeURIComponent(name)}`; }
function starter(known) {
  const choice = (label, names, first) => {
    const select = make("select", { ariaLabel: label }, ...names.map((name) => make("option", { value: name, selected: name === first }, name)));
    return [make("label", {}, label, select), select];
  };
  const [rigLabel, rig] = choice("Rig", known.rigs, "emulated-browser"), [scriptLabel, script] = choice("Script", known.scripts, "six-situations");
  const boxes = known.detectors.map((name) => make("input", { type: "checkbox", value: name, checked: name === "fused" }));
  const realtime = make("input", { type: "checkbox", checked: true });
  const chosen = () => ({ rig: rig.value, script: script.value, detectors: boxes.filter((box) => box.checked).map((box) => box.value), realtime: realtime.checked && rig.value.startsWith("emulated") });
  const result = make("pre", { id: "dry" });
  const tried = make("button", { className: "quiet", onclick: async () => {
    tried.disabled = true; problem(""); result.textContent = "Trying the script on emulators: this takes a while.";
    try { const found = await ask("/dry-run", chosen()); result.textContent = found.text; } catch (error) { result.textContent = ""; problem(error.message); }
    tried.disabled = false;
  } }, "Dry run");
  const go = make("button", { id: "start", onclick: async () => { go.disabled = true; await started(ask("/start", chosen())); go.disabled = false; } }, "Start");
  byId("new").append(make("p", { className: "row" }, rigLabel, scriptLabel), make("p", { className: "row" }, "Detectors:", ...boxes.map((box) => make("label", {}, box, box.value))), make("p", { className: "row" }, make("label", {}, realtime, "emulated rigs in real time")), make("p", { className: "row" }, tried, go), result);
}
async function started(asked) {
  problem("");
  try { const found = await asked; if (location.hash === `#/${encodeURIComponent(found.run)}`) routed(); else hintUsed(found.run); } catch (error) { problem(error.message); }
}
function routed() {
  stop.abort();
  const name = decodeURIComponent(location.hash.slice(2));
  if (name && name !== "now") { run = { name, events: [], curve: [[], []], prompt: null }; main.replaceChildren(make("p", {}, "Looking at the run.")); follow(name); } else { run = null; home(); }
}
window.addEventListener("hashchange", routed);
addEventListener("DOMContentLoaded", routed);
