// Curves over time with a line at the present moment; what stays the same is drawn once.

const CHART_PX = 110;
const PLOT = { left: 76, right: 8, top: 22, bottom: 6 };
const COLOURS = ["#56a0dc", "#e67800", "#2fc08f"];

// A colour of the present look, which style.css names.
function look(name) { return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim(); }

function columnOf(time, [from, to], width) {
  return PLOT.left + (time - from) / Math.max(to - from, 1e-9) * (width - PLOT.left - PLOT.right);
}

function timeOf(column, [from, to], width) {
  return from + (column - PLOT.left) / (width - PLOT.left - PLOT.right) * (to - from);
}

class Chart {
  // lines: [{name, values, stepped, scaledTo}], values over episode.time, null where there is none; scaledTo: how
  // many of the values the scale must hold, all by default.
  constructor(canvas, episode, span, title, lines) {
    Object.assign(this, { canvas, episode, span, title, lines });
    const known = lines.flatMap((line) => Array.from(line.values).slice(0, line.scaledTo))
      .filter((value) => value !== null);
    let [low, high] = [Infinity, -Infinity];
    for (const value of known) { low = Math.min(low, value); high = Math.max(high, value); }
    if (!known.length) [low, high] = [0, 1];
    const room = Math.max(0.08 * (high - low), 0.1);
    this.bounds = [low - room, high + room];
  }

  resize() {
    Object.assign(this, fitCanvas(this.canvas, CHART_PX));
    this.still = null;
  }

  column(time) { return columnOf(time, this.span, this.width); }

  row(value) {
    const [low, high] = this.bounds;
    return this.height - PLOT.bottom - (value - low) / (high - low) * (this.height - PLOT.top - PLOT.bottom);
  }

  timeAt(column) { return timeOf(column, this.span, this.width); }

  draw(time) {
    const { pen, canvas } = this;
    if (!this.still) {
      this.drawStill();
      this.still = document.createElement("canvas");
      this.still.width = canvas.width;
      this.still.height = canvas.height;
      this.still.getContext("2d").drawImage(canvas, 0, 0);
    }
    pen.drawImage(this.still, 0, 0, this.width, this.height);
    const now = this.column(Math.min(Math.max(time, this.span[0]), this.span[1]));
    pen.fillStyle = look("ink");
    pen.fillRect(now - 0.5, PLOT.top, 1, this.height - PLOT.top - PLOT.bottom);
    this.drawLegend(this.episode.place(time).index);
  }

  drawStill() {
    const { pen, width, height } = this;
    pen.fillStyle = look("panel");
    pen.fillRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.fillStyle = look("grid");
    for (const tick of roundNumbers(...this.span, Math.max(2, Math.floor(width / 110)))) {
      pen.fillRect(this.column(tick), PLOT.top, 1, height - PLOT.top - PLOT.bottom);
    }
    for (const value of roundNumbers(...this.bounds)) {
      pen.fillStyle = look(value === 0 ? "axis" : "grid");
      pen.fillRect(PLOT.left, this.row(value), width - PLOT.left - PLOT.right, 1);
      pen.fillStyle = look("faint");
      pen.fillText(String(value), PLOT.left - 5, this.row(value) + 4);
    }
    this.lines.forEach((line, k) => this.drawLine(line, COLOURS[k % COLOURS.length]));
  }

  drawLine(line, colour) {
    const { pen, episode } = this;
    pen.save();
    pen.beginPath();
    pen.rect(PLOT.left, PLOT.top, this.width - PLOT.left - PLOT.right, this.height - PLOT.top - PLOT.bottom);
    pen.clip();
    pen.strokeStyle = colour;
    pen.lineWidth = 1.5;
    pen.beginPath();
    let before = null;
    for (let k = 0; k < episode.samples; k++) {
      const value = line.values[k];
      const [column, row] = [this.column(episode.time[k]), value === null ? null : this.row(value)];
      if (row !== null && before === null) pen.moveTo(column, row);
      else if (row !== null) {
        if (line.stepped) pen.lineTo(column, before);
        pen.lineTo(column, row);
      }
      before = row;
    }
    pen.stroke();
    pen.restore();
  }

  // The title, and each line's name and present value in its colour.
  drawLegend(index) {
    const { pen } = this;
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "left";
    let column = PLOT.left;
    const put = (text, colour) => {
      pen.fillStyle = colour;
      pen.fillText(text, column, 15);
      column += pen.measureText(text).width + 14;
    };
    put(this.title, look("ink"));
    this.lines.forEach((line, k) => {
      const value = line.values[index];
      put(`${line.name} ${value === null ? "-" : value.toFixed(2)}`.trim(), COLOURS[k % COLOURS.length]);
    });
  }
}
