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
  const step = event.shiftKey ? 1 : 0.1;
  if (event.key === " ") setPlaying(!state.playing);
  else if (event.key === "ArrowRight") goTo(state.time + step);
  else if (event.key === "ArrowLeft") goTo(state.time - step);
  else return;
  event.preventDefault();
}

control("scrub").min = span[0];
control("scrub").max = span[1];
control("play").addEventListener("click", () => setPlaying(!state.playing));
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
  for (const chart of panel.charts) {
    chart.canvas.addEventListener("click", (event) => goTo(chart.timeAt(event.offsetX)));
  }
}
document.addEventListener("keydown", onKey);
window.addEventListener("resize", () => {
  for (const panel of panels) panel.resize();
  draw();
});
draw();
