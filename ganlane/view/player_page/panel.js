// One episode on the page: its title, road, the moment in words, and its curves.

const OUTCOMES = {
  goal: "goal",
  hard_crash: "hard crash",
  out_of_road: "out of road",
  missed_exit: "exit missed",
  timeout: "time-out",
  scene_end: "end of recording",
};

class Panel {
  constructor(told, units, span) {
    const element = document.getElementById("episode").content.cloneNode(true).firstElementChild;
    document.getElementById("episodes").append(element);
    // Nothing is fitted to its place here: the panels that follow will change it (resize).
    this.episode = new Episode(told, units);
    this.now = element.querySelector(".now");
    element.querySelector(".title").textContent = `${told.agent} on ${told.traffic}`;
    element.querySelector(".facts").textContent = this.facts();
    this.road = new Road(element.querySelector(".road"), this.episode);
    this.timeline = new Timeline(element.querySelector(".events"), this.episode, span);
    this.charts = this.curves().map(([name, title, lines]) => {
      const canvas = document.createElement("canvas");
      canvas.className = "chart";
      canvas.dataset.chart = name;
      element.querySelector(".charts").append(canvas);
      return new Chart(canvas, this.episode, span, title, lines);
    });
  }

  facts() {
    const { told } = this.episode;
    const { rms_acceleration: acceleration, rms_jerk: jerk, hardest_braking: braking } = told.comfort;
    const ending = OUTCOMES[told.outcome] || "cut off";
    return `episode ${told.episode}, seed ${told.seed}, ${told.lanes} lane${told.lanes === 1 ? "" : "s"}; ${ending} after ` +
      `${this.episode.end.toFixed(1)} s; root mean square of acceleration ${acceleration.toFixed(2)} m/s², ` +
      `of jerk ${jerk.toFixed(2)} m/s³; hardest braking ${braking.toFixed(2)} m/s²`;
  }

  // Name, title and lines of each chart; action values and reward only where the episode tells them.
  curves() {
    const { episode } = this;
    const names = episode.told.action_names;
    const values = episode.actionValues.map((one, k) => ({ name: names[k] || `${k}`, values: one, stepped: true }));
    const charts = [
      ["acceleration", "acceleration, m/s²", [{ name: "", values: episode.acceleration }]],
      ["jerk", "jerk, m/s³", [{ name: "", values: episode.jerk }]],
    ];
    if (episode.reward) {
      // What the last decision earns, +-100 where the episode ends, would flatten all others.
      const scaledTo = (episode.told.outcome && episode.told.reward.at(-2)) || undefined;
      charts.unshift(["reward", "reward per decision", [{ name: "", values: episode.reward, stepped: true, scaledTo }]]);
    }
    if (values.length) charts.unshift(["q", "Q", values]);
    return charts;
  }

  draw(time, follow) {
    const { episode } = this;
    this.road.draw(time, follow);
    for (const chart of [this.timeline, ...this.charts]) chart.draw(time);
    const { index } = episode.place(time);
    const action = episode.told.action_names[episode.action[index]] || "-";
    const ending = time >= episode.end && episode.told.outcome ? ` · ${OUTCOMES[episode.told.outcome]}` : "";
    this.now.textContent = `${episode.speed[0][index].toFixed(1)} m/s · action ${action} · ` +
      `return ${episode.returns[index].toFixed(1)}${ending}`;
  }

  resize() {
    for (const part of [this.road, this.timeline, ...this.charts]) part.resize();
  }
}
