// The clock and the controls; all episodes run on one clock.

const data = JSON.parse(document.getElementById("data").textContent);
const control = (name) => document.getElementById(name);

function spanOf(episodes, unit) {
  const ends = episodes.map((told) => told.time.reduce((sum, step) => sum + step, 0) * unit);
  return [Math.min(...episodes.map((told) => told.time[0] * unit)), Math.max(...ends)];
}

const span = spanOf(data.episodes, data.units.time);
const panels = data.episodes.map((told) => new Panel(told, data.units, span));
const state = { time: span[0], playing: false, before: null };

function draw() {
  control("time").textContent = `${state.time.toFixed(1)} s`;
  control("scrub").value = state.time;
  for (const panel of panels) panel.draw(state.time, control("follow").checked);
}

function goTo(time) {
  state.time = Math.min(Math.max(time, span[0]), span[1]);
  draw();
}

function setPlaying(playing) {
  if (playing && state.time >= span[1]) state.time = span[0];
  state.playing = playing;
  state.before = null;
  control("play").textContent = playing ? "Pause" : "Play";
  if (playing) requestAnimationFrame(tick);
}

// To the next event of any episode after now, or the one before.
function goToEvent(direction) {
  const times = panels.flatMap((panel) => panel.timeline.events.map((event) => event.time)).sort((a, b) => a - b);
  const found = direction > 0
    ? times.find((time) => time > state.time + 0.005)
    : times.filter((time) => time < state.time - 0.005).pop();
  if (found !== undefined) goTo(found);
}

function changeSpeed(by) {
  const choice = control("speed");
  choice.selectedIndex = Math.min(Math.max(choice.selectedIndex + by, 0), choice.options.length - 1);
}

function changeLook() {
  const dark = getComputedStyle(document.documentElement).colorScheme === "dark";
  document.documentElement.dataset.look = dark ? "light" : "dark";
  resize();
}

function resize() {
  for (const panel of panels) panel.resize();
  draw();
}

function tick(now) {
  if (!state.playing) return;
  const passed = state.before === null ? 0 : (now - state.before) / 1000;
  state.before = now;
  goTo(state.time + passed * Number(control("speed").value));
  if (state.time >= span[1]) setPlaying(false);
  else requestAnimationFrame(tick);
}

function letDrag(panel) {
  const { road } = panel;
  let from = null;
  road.canvas.addEventListener("pointerdown", (event) => {
    if (control("follow").checked) return;
    from = { column: event.clientX, centre_m: road.centre_m };
    road.canvas.setPointerCapture(event.pointerId);
  });
  road.canvas.addEventListener("pointermove", (event) => {
    if (from === null) return;
    road.centre_m = from.centre_m - (event.clientX - from.column) / road.along;
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    road.canvas.addEventListener(end, () => { from = null; });
  }
}

function onKey(event) {
  if (event.target.matches("select, button, input:not([type=range])")) return;
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? 1 : 0.1;
  if (event.key === " ") setPlaying(!state.playing);
  else if (event.key === "ArrowRight") goTo(state.time + step);
  else if (event.key === "ArrowLeft") goTo(state.time - step);
  else if (event.key === "e" || event.key === "E") goToEvent(event.shiftKey ? -1 : 1);
  else if (event.key === "+" || event.key === "=") changeSpeed(1);
  else if (event.key === "-") changeSpeed(-1);
  else if (event.key === "l") changeLook();
  else return;
  event.preventDefault();
}

control("scrub").min = span[0];
control("scrub").max = span[1];
control("play").addEventListener("click", () => setPlaying(!state.playing));
control("next").addEventListener("click", () => goToEvent(1));
control("back").addEventListener("click", () => goToEvent(-1));
control("look").addEventListener("click", changeLook);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", resize);
control("scrub").addEventListener("input", () => goTo(Number(control("scrub").value)));
control("follow").addEventListener("change", () => {
  for (const panel of panels) panel.road.canvas.classList.toggle("loose", !control("follow").checked);
  draw();
});
control("road").addEventListener("change", () => {
  for (const panel of panels) {
    panel.road.road_m = Number(control("road").value);
    panel.road.resize();
  }
  draw();
});
for (const panel of panels) {
  letDrag(panel);
  for (const chart of [panel.timeline, ...panel.charts]) {
    chart.canvas.addEventListener("click", (event) => goTo(chart.timeAt(event.offsetX)));
  }
}
document.addEventListener("keydown", onKey);
window.addEventListener("resize", resize);
resize();
