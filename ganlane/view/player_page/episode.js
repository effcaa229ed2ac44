// An episode, decoded; ganlane/view/player.py describes "series" and "steps".

// A vehicle that moves further than this between two samples was put elsewhere, m per 0.1 s.
const JUMP_M = 30;

function decodeSeries(differences, unit) {
  let sum = 0;
  return Float64Array.from(differences, (difference) => (sum += difference) * unit);
}

function decodeSteps(changes, samples) {
  const values = new Array(samples).fill(null);
  for (let k = 0; k < changes.length; k += 2) {
    values.fill(changes[k + 1], changes[k], k + 2 < changes.length ? changes[k + 2] : samples);
  }
  return values;
}

class Episode {
  constructor(told, units) {
    this.told = told;
    this.time = decodeSeries(told.time, units.time);
    this.samples = this.time.length;
    this.vehicles = told.x.length;
    for (const name of ["x", "y", "heading", "speed"]) {
      this[name] = told[name].map((one) => decodeSeries(one, units[name]));
    }
    for (const name of ["length", "width", "target_lane", "valid"]) {
      this[name] = told[name].map((one) => decodeSteps(one, this.samples));
    }
    this.acceleration = decodeSeries(told.acceleration, units.acceleration);
    this.jerk = decodeSeries(told.jerk, units.jerk);
    this.action = decodeSteps(told.action, this.samples);
    this.returns = decodeSteps(told.return, this.samples);
    this.reward = told.reward.length ? decodeSteps(told.reward, this.samples) : null;
    this.actionValues = told.action_values.map((one) => decodeSteps(one, this.samples));
  }

  get start() { return this.time[0]; }
  get end() { return this.time[this.samples - 1]; }

  // Whether a vehicle was put elsewhere between the samples `first` and `second`.
  jumps(v, first, second) {
    const most = JUMP_M * Math.max(1, Math.abs(this.time[second] - this.time[first]) / 0.1);
    return Math.abs(this.x[v][second] - this.x[v][first]) > most;
  }

  // The last sample not after `time`, and how much of the way to the next one has passed (0 to 1).
  place(time) {
    let low = 0;
    let high = this.samples - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.time[middle] <= time + 1e-9) low = middle; else high = middle - 1;
    }
    const next = Math.min(low + 1, this.samples - 1);
    const step = this.time[next] - this.time[low];
    const share = step > 0 ? Math.min(Math.max((time - this.time[low]) / step, 0), 1) : 0;
    return { index: low, next, share, step };
  }

  // A vehicle between two samples; null where there is none.
  vehicle(v, place) {
    const { index, next, share, step } = place;
    if (!this.valid[v][index]) return null;
    const goesOn = this.valid[v][next] && !this.jumps(v, index, next);
    const part = goesOn ? share : 0;
    const between = (values) => values[index] + part * (values[next] - values[index]);
    return {
      x: between(this.x[v]),
      y: between(this.y[v]),
      heading: between(this.heading[v]),
      speed: between(this.speed[v]),
      length: this.length[v][index],
      width: this.width[v][index],
      targetLane: this.target_lane[v][index],
      braking: goesOn && step > 0 && (this.speed[v][next] - this.speed[v][index]) / step < -0.8,
    };
  }
}
