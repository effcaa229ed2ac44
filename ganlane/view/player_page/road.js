// The road seen from above, with the vehicles of one moment.

const EGO = "rgb(255,150,28)";
const CRASH = "rgb(255,62,62)";
const FAST_MPS = 35;
const LEAST_ACROSS = 3.5; // pixels per m
const MARGIN_PX = 26;
const TRAIL_S = 3;

// Canvas pixels are the screen's own; everything is drawn in CSS pixels.
function fitCanvas(canvas, height) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.max(canvas.clientWidth, 1);
  canvas.style.height = `${height}px`;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { pen, width, height };
}

function speedTint(speed) {
  const [slow, middle, fast] = [[38, 52, 128], [58, 122, 224], [158, 226, 255]];
  const share = 2 * Math.min(Math.max(speed / FAST_MPS, 0), 1);
  const [from, to, part] = share <= 1 ? [slow, middle, share] : [middle, fast, share - 1];
  return `rgb(${from.map((value, k) => Math.round(value + part * (to[k] - value))).join(",")})`;
}

class Road {
  constructor(canvas, episode) {
    this.canvas = canvas;
    this.episode = episode;
    this.road_m = 160;
    this.centre_m = 0; // of the picture, where it does not follow the ego
  }

  resize() {
    const { lanes, lane_width_m: laneWidth } = this.episode.told;
    const along = Math.max(this.canvas.clientWidth, 1) / this.road_m;
    this.across = Math.max(along, LEAST_ACROSS);
    Object.assign(this, fitCanvas(this.canvas, lanes * laneWidth * this.across + 2 * MARGIN_PX));
    this.along = this.width / this.road_m;
  }

  column(x) { return (x - this.start_m) * this.along; }

  row(y) {
    const { lanes, lane_width_m: laneWidth } = this.episode.told;
    return MARGIN_PX + ((lanes - 0.5) * laneWidth - y) * this.across;
  }

  draw(time, follow) {
    const place = this.episode.place(time);
    const ego = this.episode.vehicle(0, place);
    if (follow && ego) this.centre_m = ego.x + 0.12 * this.road_m;
    this.start_m = this.centre_m - this.road_m / 2;
    this.drawGround();
    for (let v = this.episode.vehicles - 1; v >= 0; v--) {
      const vehicle = this.episode.vehicle(v, place);
      if (!vehicle || Math.abs(vehicle.x - this.centre_m) > this.road_m / 2 + 20) continue;
      this.drawTrail(v, place, vehicle);
      this.drawVehicle(vehicle, v === 0, time);
    }
    if (this.episode.told.outcome === "hard_crash" && time >= this.episode.end && ego) this.drawCrash(ego);
  }

  drawGround() {
    const { pen, width, height } = this;
    const { lanes, lane_width_m: laneWidth } = this.episode.told;
    const [top, bottom] = [this.row((lanes - 0.5) * laneWidth), this.row(-0.5 * laneWidth)];
    pen.fillStyle = look("verge");
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = look("asphalt");
    pen.fillRect(0, top - 3, width, bottom - top + 6);
    pen.fillStyle = "#d6d6d0";
    for (const edge of [top, bottom]) pen.fillRect(0, edge - 1, width, 2);
    for (let lane = 1; lane < lanes; lane++) {
      const mark = this.row((lane - 0.5) * laneWidth);
      for (let x = Math.floor(this.start_m / 18) * 18; x < this.start_m + this.road_m; x += 18) {
        pen.fillRect(this.column(x), mark - 0.75, 6 * this.along, 1.5);
      }
    }
    this.episode.told.stretches.forEach((stretch, lane) => this.drawEnds(lane, stretch));
    pen.fillStyle = look("faint");
    pen.font = "11px system-ui, sans-serif";
    const factor = this.across / this.along;
    pen.textAlign = "right";
    if (factor > 1.05) pen.fillText(`drawn ${factor.toFixed(1)} times as wide as it is`, width - 8, 14);
    pen.textAlign = "left";
    const every = this.road_m > 200 ? 100 : 50;
    for (let x = Math.ceil(this.start_m / every) * every; x < this.start_m + this.road_m; x += every) {
      pen.fillRect(this.column(x), bottom + 6, 1.5, 10);
      pen.fillText(`${x} m`, this.column(x) + 5, bottom + 16);
    }
  }

  // No road before an exit lane and behind a wall, which is red; a kerb beside a ramp.
  drawEnds(lane, { begin_m: begin, end_m: end, end: kind }) {
    const { pen, width } = this;
    const { lanes, lane_width_m: laneWidth } = this.episode.told;
    const within = (x) => Math.min(Math.max(this.column(x), 0), width);
    const [upper, lower] = [this.row((lane + 0.5) * laneWidth), this.row((lane - 0.5) * laneWidth)];
    const top = lane === lanes - 1 ? upper - 4 : upper + 1.5;
    const bottom = lane === 0 ? lower + 4 : lower - 1.5;
    const before = [0, within(begin)];
    const behind = [within(end), width];
    const [nothing, ramp] = kind === "exit" ? [before, behind] : [behind, before];
    pen.fillStyle = look("verge");
    pen.fillRect(nothing[0], top, nothing[1] - nothing[0], bottom - top);
    if (lane < lanes - 1) pen.fillRect(ramp[0], upper - 2, ramp[1] - ramp[0], 4);
    if (lane > 0) pen.fillRect(ramp[0], lower - 2, ramp[1] - ramp[0], 4);
    if (kind !== "wall") return;
    pen.fillStyle = look("crash");
    pen.fillRect(this.column(end), top, this.along, bottom - top);
  }

  drawTrail(v, place, vehicle) {
    const { pen, episode } = this;
    pen.strokeStyle = v === 0 ? "rgba(255,255,255,0.7)" : "rgba(255,255,255,0.28)";
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(this.column(vehicle.x), this.row(vehicle.y));
    for (let k = place.index; k >= 0 && episode.time[place.index] - episode.time[k] < TRAIL_S; k--) {
      if (!episode.valid[v][k] || (k < place.index && episode.jumps(v, k, k + 1))) break;
      pen.lineTo(this.column(episode.x[v][k]), this.row(episode.y[v][k]));
    }
    pen.stroke();
  }

  drawVehicle(vehicle, isEgo, time) {
    const { pen } = this;
    const [length, width] = [vehicle.length, vehicle.width];
    pen.save();
    pen.translate(this.column(vehicle.x), this.row(vehicle.y));
    pen.scale(this.along, -this.across);
    pen.rotate(vehicle.heading);
    pen.fillStyle = isEgo ? EGO : speedTint(vehicle.speed);
    if (isEgo) this.drawArrow(length, width);
    else pen.fillRect(-length / 2, -width / 2, length, width);
    pen.fillStyle = "#181c24";
    if (!isEgo) pen.fillRect(0.14 * length, -0.4 * width, 0.12 * length, 0.8 * width);
    if (vehicle.braking) {
      pen.fillStyle = "#ff3028";
      pen.fillRect(-length / 2, -width / 2, 0.07 * length, width);
    }
    const offset = vehicle.targetLane * this.episode.told.lane_width_m - vehicle.y;
    if (Math.abs(offset) > 0.4 && time % 0.6 < 0.36) {
      pen.fillStyle = "#ffd640";
      const side = offset > 0 ? 0.32 : -0.5;
      pen.fillRect(0.34 * length, side * width, 0.16 * length, 0.18 * width);
      pen.fillRect(-0.5 * length, side * width, 0.12 * length, 0.18 * width);
    }
    pen.restore();
    this.writeSpeed(vehicle, isEgo);
  }

  // The ego's own shape: pointed, with a white edge.
  drawArrow(length, width) {
    const { pen } = this;
    pen.beginPath();
    for (const [x, y] of [[-0.5, -0.5], [0.2, -0.5], [0.5, 0], [0.2, 0.5], [-0.5, 0.5]]) pen.lineTo(x * length, y * width);
    pen.closePath();
    pen.fill();
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 1.5 / this.along;
    pen.stroke();
  }

  // On the roof, or above it where the roof is too small.
  writeSpeed(vehicle, isEgo) {
    const { pen } = this;
    const onRoof = this.along * vehicle.length > 30;
    const column = this.column(vehicle.x - (onRoof ? 0.14 * vehicle.length : 0));
    const row = this.row(vehicle.y) + (onRoof ? 4 : -0.5 * vehicle.width * this.across - 2);
    pen.fillStyle = onRoof && (isEgo || vehicle.speed > 20) ? "#101216" : "#ffffff";
    pen.font = `${onRoof ? 11 : 9}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.fillText(vehicle.speed.toFixed(0), column, row);
  }

  drawCrash(ego) {
    const { pen } = this;
    pen.strokeStyle = CRASH;
    pen.lineWidth = 3;
    pen.beginPath();
    pen.arc(this.column(ego.x), this.row(ego.y), 6 * this.along, 0, 2 * Math.PI);
    pen.stroke();
  }
}
