// The operator page: shows the readings that the server sends at 30 Hz, and sends the operator's holds and orders.
"use strict";

const HOLD_PERIOD_MS = 50;  // ms between two messages of a hold
const TURN_PER_SPEED = 1.6;  // rad/s at the pad's edge per m/s of the selected speed, which counts up to 1.2
const SIDEWAYS_SHARE = 0.6;  // share of the selected speed
const GRAPH_DURATION_S = 10;  // s shown in the graphs
const NEWS_TIMEOUT_S = 1.5;  // s without readings, which are expected at 30 Hz
const SCENE_TIMEOUT_MS = 30_000;  // ms after which the 3-D view should be loaded
const DASH = "\u2013";
const AXES = [["forward", "m/s"], ["left", "m/s"], ["turn", "rad/s"]];
const LEGS = ["FR", "FL", "RR", "RL"], JOINTS = ["hip", "thigh", "calf"];
const $ = (id) => document.getElementById(id);

let socket = null;
let state = null;

function send(word) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(word));
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${scheme}//${location.host}/words`);
  socket.onmessage = (event) => show(JSON.parse(event.data));
  socket.onopen = () => document.body.classList.remove("lost");
  socket.onclose = () => {
    document.body.classList.add("lost");
    $("mode").className = "pill fault";
    $("mode").textContent = "no connection";
    $("reason").textContent = "connection to `quadvel view` lost; reconnecting";
    $("refusal").textContent = "";
    releaseAll();
    setTimeout(connect, 1000);
  };
}

// Input: what is held, by pointer or by key. Without a hold no messages are sent.

const held = { pad: null, strafe: null, keys: new Set() };
const KEYS = { KeyW: [1, 0, 0], KeyS: [-1, 0, 0], KeyA: [0, 0, 1], KeyD: [0, 0, -1], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
               ArrowUp: [1, 0, 0], ArrowDown: [-1, 0, 0], ArrowLeft: [0, 0, 1], ArrowRight: [0, 0, -1] };
let wasHeld = false;

function heldVelocity() {
  const share = [0, 0, 0];
  if (held.pad) { share[0] += held.pad[1]; share[2] += held.pad[0]; }
  if (held.strafe) share[1] += held.strafe[0];
  for (const key of held.keys) KEYS[key].forEach((value, axis) => { share[axis] += value; });
  const speed = Number($("speed").value);
  const scale = [speed, SIDEWAYS_SHARE * speed, TURN_PER_SPEED * Math.min(speed, 1.2)];
  return share.map((value, axis) => Math.max(-1, Math.min(1, value)) * scale[axis]);
}

function isHeld() { return held.pad !== null || held.strafe !== null || held.keys.size > 0; }

function sendHold() {
  if (isHeld()) { send({ do: "hold", velocity: heldVelocity() }); wasHeld = true; }
  else if (wasHeld) { send({ do: "let_go" }); wasHeld = false; }
}

function releaseAll() {
  for (const name of ["pad", "strafe"]) { held[name] = null; placeKnob($(name), 0, 0); $(name).classList.remove("held"); }
  held.keys.clear();
  sendHold();
}

function placeKnob(element, x, y) {
  const knob = element.querySelector(".knob");
  knob.style.setProperty("--x", `${x}px`);
  knob.style.setProperty("--y", `${y}px`);
}

// name: id of the dragged element; both: whether it also moves vertically.
function draggable(name, both) {
  const element = $(name);
  const follow = (event) => {
    const box = element.getBoundingClientRect();
    let x = event.clientX - box.left - box.width / 2, y = both ? event.clientY - box.top - box.height / 2 : 0;
    const far = Math.hypot(x, y), most = (box.width - element.querySelector(".knob").offsetWidth) / 2;
    if (far > most) { x *= most / far; y *= most / far; }
    held[name] = [-x / most, -y / most];
    placeKnob(element, x, y);
    sendHold();
  };
  const end = () => { held[name] = null; placeKnob(element, 0, 0); element.classList.remove("held"); sendHold(); };
  element.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    element.focus({ preventScroll: true });
    element.setPointerCapture(event.pointerId);
    element.classList.add("held");
    follow(event);
  });
  element.addEventListener("pointermove", (event) => { if (held[name]) follow(event); });
  for (const over of ["pointerup", "pointercancel", "lostpointercapture"]) element.addEventListener(over, end);
}

function toggleStop() { send({ do: state && state.stopped ? "release" : "stop" }); }

addEventListener("keydown", (event) => {
  if (document.body.classList.contains("playing")) return;
  if (event.code === "Space") { event.preventDefault(); if (!event.repeat) { releaseAll(); send({ do: "stop" }); } }
  else if (event.code in KEYS && !event.ctrlKey && !event.altKey && event.target.type !== "range") {
    event.preventDefault();
    held.keys.add(event.code);
  }
});
addEventListener("keyup", (event) => { if (event.code === "Space") event.preventDefault(); if (held.keys.delete(event.code)) sendHold(); });
for (const over of ["blur", "pagehide"]) addEventListener(over, releaseAll);
// After a click into the scene, return the focus, so that the space bar still works.
addEventListener("blur", () => setTimeout(() => { if (document.activeElement === $("scene")) { $("scene").blur(); window.focus(); } }));
document.addEventListener("visibilitychange", () => { if (document.hidden) releaseAll(); });
setInterval(sendHold, HOLD_PERIOD_MS);

// Readings.

const samples = [];  // [ms, commanded, measured]

let heardAt = performance.now();

function show(news) {
  state = news;
  heardAt = performance.now();
  const playing = news.playback !== null;
  document.body.classList.toggle("playing", playing);
  document.body.classList.toggle("stopped", news.stopped);
  $("operator").hidden = playing;
  $("playback").hidden = !playing;
  $("simulation").hidden = !news.simulated;
  $("mode").textContent = news.mode.replace("_", " ") || (playing ? "recording" : "no data");
  $("mode").className = `pill ${news.mode}`;
  $("reason").textContent = playing && !news.mode ? news.playback.name : news.reason;
  $("refusal").textContent = news.refusal;
  $("stop").innerHTML = news.stopped ? "<b>STOPPED</b><small>press to release</small>" : "<b>STOP</b><small>space</small>";
  $("said").textContent = news.said || "";
  $("record").classList.toggle("on", Boolean(news.recording));
  $("record").lastElementChild.textContent = news.recording ? "Recording" : "Record";
  document.querySelectorAll("#modes button").forEach((one) => one.classList.toggle("on", one.dataset.do === news.mode));
  if (playing) showPlayback(news.playback);
  samples.push([performance.now(), news.commanded, news.measured]);
  while (samples.length && samples[0][0] < performance.now() - 1000 * GRAPH_DURATION_S) samples.shift();
}

function drawReadings() {
  if (!state) return;
  document.querySelectorAll(".graph").forEach((graph, axis) => {
    graph.lastElementChild.textContent = signed(state.measured[axis]);
    drawGraph(graph.querySelector("canvas"), axis);
  });
  document.querySelectorAll(".bar").forEach((bar, joint) => {
    const share = Math.min(Math.abs(state.torque[joint] ?? 0), 1);
    bar.firstElementChild.style.transform = `scaleY(${share})`;
    bar.className = `bar ${share > 0.95 ? "full" : share > 0.7 ? "high" : ""}`;
  });
  const { rate, period, compute, missed } = state.loop;
  const rows = rate === undefined ? [["", "no data"]]
    : [["rate", numberText(rate, 0, " Hz")], ["period", numberText(period, 1, " ms")], ["compute", numberText(compute && compute / 1000, 1, " ms")], ["missed", missed]];
  fill(document.querySelector("#loop dl"), rows.flatMap(([name, value]) => [["dt", name], ["dd", value]]));
  showLamps(state.lamps);
  const silence = (performance.now() - heardAt) / 1000;
  fill($("notices"), [...state.notices, ...(silence > NEWS_TIMEOUT_S ? [`no data from quadvel view for ${silence.toFixed(0)} s`] : [])].map((one) => ["li", one]));
}

// Format a number; a dash if it is unknown.
function numberText(value, digits, unit = "") { return value === null ? DASH : value.toFixed(digits) + unit; }

function fill(parent, children) {
  parent.replaceChildren(...children.map(([tag, text]) => Object.assign(document.createElement(tag), { textContent: text })));
}

let shownLamps = "";
function showLamps(lamps) {
  const text = JSON.stringify(lamps);
  if (text === shownLamps) return;
  shownLamps = text;
  $("lamps").replaceChildren(...lamps.map((lamp) => {
    const item = document.createElement("li"), words = document.createElement("span");
    item.className = lamp.level;
    item.title = lamp.text;
    fill(words, [["b", lamp.name], ["span", ` ${lamp.text}`]]);
    item.append(words);
    return item;
  }));
}

function signed(value) { return value === null ? DASH : (value < 0 ? "\u2212" : "+") + Math.abs(value).toFixed(2); }

function drawGraph(canvas, axis) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth * ratio, height = canvas.clientHeight * ratio;
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d"), now = performance.now();
  const most = Math.max(0.6, ...samples.map(([, asked, got]) => Math.max(Math.abs(asked[axis] ?? 0), Math.abs(got[axis] ?? 0))));
  context.clearRect(0, 0, width, height);
  context.fillStyle = "#252c37";
  context.fillRect(0, height / 2, width, ratio);
  for (const [which, colour] of [[2, "#4cc2ff"], [1, "#ff9a4d"]]) {
    context.strokeStyle = colour;
    context.lineWidth = 1.5 * ratio;
    context.beginPath();
    let gap = true;
    for (const one of samples) {
      if (one[which][axis] === null) { gap = true; continue; }
      context[gap ? "moveTo" : "lineTo"](width * (1 - (now - one[0]) / (1000 * GRAPH_DURATION_S)), height * (0.5 - 0.46 * one[which][axis] / most));
      gap = false;
    }
    context.stroke();
  }
}

// Playback.

let seeking = false;

function showPlayback({ time, length, playing, pace, name }) {
  $("play").textContent = playing ? "Pause" : "Play";
  $("time").max = length;
  if (!seeking) $("time").value = time;
  $("at").textContent = `${time.toFixed(1)} s`;
  $("length").textContent = `${length.toFixed(1)} s`;
  document.title = name;
  document.querySelectorAll("#paces button").forEach((one) => one.classList.toggle("on", Number(one.dataset.pace) === pace));
}

// Initialisation.

AXES.forEach(([name, unit]) => {
  const graph = document.createElement("div");
  graph.className = "graph";
  graph.innerHTML = `<span>${name}</span><canvas></canvas><output></output>`;
  graph.title = unit;
  document.querySelector(".graphs").append(graph);
});
LEGS.forEach((leg) => {
  const bars = document.createElement("div");
  bars.innerHTML = JOINTS.map((joint) => `<div class="bar" title="${leg} ${joint}"><i></i></div>`).join("") + `<span>${leg}</span>`;
  $("torques").append(bars);
});
draggable("pad", true);
draggable("strafe", false);
$("stop").addEventListener("click", () => { releaseAll(); toggleStop(); });
const FIELDS = { reset: () => ({ terrain: $("ground").value }), push: (button) => ({ to: button.dataset.to }) };  // fields of the orders that have any
document.querySelectorAll("[data-do]").forEach((one) => one.addEventListener("click", () => send({ do: one.dataset.do, ...FIELDS[one.dataset.do]?.(one) })));
$("speed").addEventListener("input", () => { $("top").textContent = `${Number($("speed").value).toFixed(1)} m/s`; });
$("speed").dispatchEvent(new Event("input"));
$("play").addEventListener("click", () => send({ do: "play" }));
$("time").addEventListener("input", () => { seeking = true; send({ do: "seek", time: Number($("time").value) }); });
$("time").addEventListener("change", () => { seeking = false; });
document.querySelectorAll("#paces button").forEach((one) => one.addEventListener("click", () => send({ do: "pace", pace: Number(one.dataset.pace) })));
setInterval(drawReadings, 100);

addEventListener("message", (event) => { if (event.source === $("scene").contentWindow && event.data === "drawn") $("loading").hidden = true; });
setTimeout(() => { $("loading").textContent = "no 3-D view yet: this browser may lack WebGL, or be too busy"; }, SCENE_TIMEOUT_MS);

// With the other name of this host the scene is another site, which the browser renders in another process. With a token
// both have the same name, because its cookie is bound to the name that set it.
const OTHER_NAME = "withToken" in $("scene").dataset ? {} : { "127.0.0.1": "localhost", localhost: "127.0.0.1" };
$("scene").src = `${location.protocol}//${OTHER_NAME[location.hostname] || location.hostname}:${location.port}/scene/?darkMode`;
connect();
