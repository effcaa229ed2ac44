// What happens to the ego over time, as marks on an axis: lane changes, soft crashes, and how the episode ends.

const EVENTS_PX = 44;
const EVENT_COLOURS = { left: "#56a0dc", right: "#56a0dc", soft: "#e6a700", hard: "#ff3e3e", end: "#2fc08f" };
const EVENT_NAMES = { left: "to the left", right: "to the right", soft: "soft crash", hard: "hard crash", end: "end" };

// [{time, kind}] in the order of time.
function eventsOf(episode) {
  const { told } = episode;
  const lane = episode.target_lane[0];
  const found = told.soft_crash.map((time) => ({ time, kind: "soft" }));
  for (let k = 1; k < episode.samples; k++) {
    if (lane[k] !== lane[k - 1]) found.push({ time: episode.time[k], kind: lane[k] > lane[k - 1] ? "left" : "right" });
  }
  if (told.outcome) found.push({ time: episode.end, kind: told.outcome === "hard_crash" ? "hard" : "end" });
  return found.sort((a, b) => a.time - b.time);
}

// Round numbers, 1, 2 or 5 times a power of ten apart, about four of them (or `count`).
function roundNumbers(low, high, count = 4) {
  const power = 10 ** Math.floor(Math.log10((high - low) / (count - 1)));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= (high - low) / count);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(Number((k * step).toPrecision(6)));
  return found;
}

class Timeline {
  constructor(canvas, episode, span) {
    Object.assign(this, { canvas, episode, span, events: eventsOf(episode) });
  }

  resize() { Object.assign(this, fitCanvas(this.canvas, EVENTS_PX)); }

  column(time) { return columnOf(time, this.span, this.width); }

  timeAt(column) { return timeOf(column, this.span, this.width); }

  draw(time) {
    const { pen, width, height } = this;
    pen.fillStyle = look("panel");
    pen.fillRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "center";
    for (const tick of roundNumbers(...this.span, Math.max(2, Math.floor(width / 110)))) {
      pen.fillStyle = look("axis");
      pen.fillRect(this.column(tick), 24, 1, 5);
      pen.fillStyle = look("faint");
      pen.fillText(`${tick} s`, Math.min(this.column(tick), width - 18), height - 4);
    }
    pen.fillStyle = look("axis");
    pen.fillRect(PLOT.left, 24, width - PLOT.left - PLOT.right, 1);
    for (const event of this.events) this.drawMark(event);
    pen.fillStyle = look("ink");
    pen.fillRect(this.column(Math.min(Math.max(time, this.span[0]), this.span[1])) - 0.5, 4, 1, 24);
    const near = this.events.filter((event) => Math.abs(event.time - time) < 0.55).pop();
    pen.textAlign = "left";
    pen.fillText(near ? EVENT_NAMES[near.kind] : "events", 4, 14);
  }

  // Triangles point to the side of a lane change; a diamond is a soft crash, a cross a hard one, a square the end.
  drawMark({ time, kind }) {
    const { pen } = this;
    const shapes = {
      left: [[-5, 4], [0, -5], [5, 4]], right: [[-5, -5], [0, 4], [5, -5]], soft: [[-5, 0], [0, -6], [5, 0], [0, 6]],
      hard: [[-6, -4], [-4, -6], [0, -2], [4, -6], [6, -4], [2, 0], [6, 4], [4, 6], [0, 2], [-4, 6], [-6, 4], [-2, 0]],
      end: [[-4, -4], [4, -4], [4, 4], [-4, 4]],
    };
    pen.fillStyle = EVENT_COLOURS[kind];
    pen.beginPath();
    for (const [right, down] of shapes[kind]) pen.lineTo(this.column(time) + right, 14 + down);
    pen.fill();
  }
}
