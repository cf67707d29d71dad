"use strict";
// The episode explorer: choose, list, watch, and compare two agents in the same scenario.

class Explorer {
  constructor(root, tasks, numbers) {
    Object.assign(this, { root, tasks, numbers, time: 0, playing: false, speed: 1, by: 0, cache: new Map() });
    this.part = (name) => root.querySelector(`[data-part="${name}"]`);
    this.fill("task", tasks.map((task, n) => [n, task.label]));
    for (const name of ["task", "agent", "other", "level", "which"]) {
      this.part(name).addEventListener("change", () => this.chosen(name));
    }
    this.part("play").addEventListener("click", () => this.toggle());
    this.part("scrub").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    this.part("speed").addEventListener("change", (event) => (this.speed = Number(event.target.value)));
    root.addEventListener("keydown", (event) => this.key(event));
    const plot = this.part("plot");
    const pointed = (event) => event.buttons && this.seek(this.plotTime(event));
    plot.addEventListener("pointerdown", pointed);
    plot.addEventListener("pointermove", pointed);
    new ResizeObserver(() => this.paint()).observe(this.part("panels"));
    dark.addEventListener("change", () => this.paint());
    this.chosen("task");
  }

  fill(name, options) {
    const kept = this.part(name).value;
    this.part(name).replaceChildren(...options.map(([value, words]) => new Option(words, value)));
    if (options.some(([value]) => String(value) === kept)) this.part(name).value = kept;
  }

  get task() { return this.tasks[Number(this.part("task").value)]; }

  chosen(what) {
    const { task } = this, before = this.scenario;
    if (what === "task") {
      const agents = task.agents.map((agent, n) => [n, agent.label]);
      this.fill("agent", agents);
      this.fill("other", [[-1, "nobody"], ...agents]);
      this.fill("level", task.levels.map((level) => [level, `${level}${level ? "" : " (true readings)"}`]));
      this.part("agent").value = 0;
      this.part("other").value = task.agents.length > 1 ? 1 : -1;
      this.part("level").value = task.levels.reduce((a, b) => (Math.abs(b - 1) < Math.abs(a - 1) ? b : a));
    }
    this.list();
    const there = what !== "task" && this.rows.some((row) => row.scenario === before);
    this.part("watched").hidden = !this.rows.length;
    if (this.rows.length) this.watch(there ? before : this.rows[0].scenario);
    else if (this.playing) this.toggle();
  }

  episode(agent, scenario) {
    const level = Number(this.part("level").value);
    const fits = (one) => one.agent === agent && one.level === level && one.scenario === scenario;
    return this.task.episodes.find(fits);
  }

  // The rows of the list: by the least clearance of one of the agents (0, 1), or by their numbers (-1).
  list() {
    const { task } = this, agent = Number(this.part("agent").value), other = Number(this.part("other").value);
    const agents = [agent, other].filter((each) => each >= 0);
    this.by = Math.min(this.by, agents.length - 1);
    const least = (number) => this.episode(agents[this.by], number)?.least ?? Infinity;
    const which = this.part("which").value;
    const wanted = ({ episode, why }) => episode && (which === "all" || why === which || (which === "unsafe" && episode.cost > 0));
    this.rows = Object.entries(task.scenarios)
      .map(([number, { why }]) => ({ scenario: Number(number), why, episode: this.episode(agent, Number(number)) }))
      .filter(wanted)
      .sort((a, b) => (this.by < 0 ? a.scenario - b.scenario : least(a.scenario) - least(b.scenario)));
    const names = ["Scenario", ...agents.map((each) => task.agents[each].label)];
    this.part("head").replaceChildren(...names.map((name, n) => this.heading(name, n - 1)));
    this.part("rows").replaceChildren(...this.rows.map((row) => this.row(row, other)));
    this.part("none").textContent = this.rows.length ? "" : "No such episode is among those that are shown.";
  }

  heading(name, by) {
    const made = cell("th", ""), button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.title = by < 0 ? "By number" : "The least clearance first";
    if (this.by === by) made.setAttribute("aria-sort", "ascending");
    made.append(button);
    button.addEventListener("click", () => {
      this.by = by;
      this.list();
      this.mark();
      this.part("head").children[by + 1].firstChild.focus();
    });
    return made;
  }

  row({ scenario, why, episode }, other) {
    const line = document.createElement("tr"), button = document.createElement("button");
    button.type = "button";
    button.textContent = `${scenario}`;
    button.setAttribute("aria-label", `Watch scenario ${scenario}`);
    const first = cell("th", "");
    first.append(button, mark(why));
    line.append(first, result(episode));
    if (other >= 0) line.append(result(this.episode(other, scenario)));
    line.dataset.scenario = scenario;
    line.addEventListener("click", () => {
      this.watch(scenario);
      this.part("panels").scrollIntoView({ block: "nearest" });
      if (!this.playing && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.toggle();
    });
    return line;
  }

  decode(episode) {
    if (!this.cache.has(episode)) this.cache.set(episode, decoded(this.task, episode, this.numbers));
    return this.cache.get(episode);
  }

  watch(scenario) {
    this.scenario = scenario;
    this.mark();
    const agents = [this.part("agent").value, this.part("other").value].map(Number);
    const shown = agents.map((agent) => this.episode(agent, scenario)).filter(Boolean);
    this.panels(shown);
    this.length = Math.max(...shown.map((episode) => episode.steps));
    this.part("scrub").max = this.length;
    this.seek(0);
  }

  // Shows which row of the list is watched, and brings it into the list's view.
  mark() {
    const list = this.part("rows").closest(".episodes");
    for (const line of this.part("rows").children) {
      const current = Number(line.dataset.scenario) === this.scenario;
      line.classList.toggle("current", current);
      if (current) line.setAttribute("aria-current", "true");
      else line.removeAttribute("aria-current");
      if (!current) continue;
      const view = list.getBoundingClientRect(), box = line.getBoundingClientRect();
      const above = view.top + this.part("head").offsetHeight - box.top, below = box.bottom - view.bottom;
      list.scrollTop += above > 0 ? -above : Math.max(below, 0);
    }
  }

  // The least box around the task's own and all places of the robot in these episodes: nothing leaves the picture.
  bounds(episodes) {
    const low = this.task.low.slice(), high = this.task.high.slice();
    for (const episode of episodes) {
      const data = this.decode(episode), first = data.body ? Array.from(data.body(0)) : [];
      const places = Array.from({ length: episode.steps + 1 }, (_, t) => Array.from(data.position(t))).flat();
      for (const list of [first, places]) {
        list.forEach((value, i) => {
          const axis = i % this.task.dim;
          low[axis] = Math.min(low[axis], value);
          high[axis] = Math.max(high[axis], value);
        });
      }
    }
    return { low, high };
  }

  panels(episodes) {
    const { task } = this, box = this.part("panels"), bounds = this.bounds(episodes);
    box.replaceChildren();
    this.scenes = episodes.map((episode) => {
      const agent = task.agents[episode.agent], figure = document.createElement("figure");
      const canvas = document.createElement("canvas"), caption = document.createElement("figcaption");
      const name = document.createElement("strong"), ended = document.createElement("span");
      name.textContent = agent.label;
      name.style.borderColor = seen(agent.colour);
      ended.textContent = `${outcome(episode)}, ${episode.steps} steps`;
      ended.className = kind(episode);
      caption.append(name, ended);
      canvas.setAttribute("role", "img");
      figure.append(caption, canvas);
      box.append(figure);
      return new Scene(canvas, task, agent.colour).show(episode, this.decode(episode), bounds);
    });
    for (const scene of this.scenes) {
      scene.turned = (angle) => this.scenes.forEach((each) => { each.angle = angle; each.draw(each.time); });
      if (this.angle && task.dim === 3) scene.angle = this.angle;
    }
    box.classList.toggle("two", episodes.length > 1);
    box.classList.toggle("space", task.dim === 3);
    const agent = task.agents[episodes[0].agent], level = this.part("level").value;
    this.part("command").replaceChildren(...unbroken(`python -m benchmarks.replay ${this.root.dataset.run} --env ${task.env} ` +
      `--agent ${agent.row} --noise-level ${level} --scenario ${this.scenario} --out clip.mp4 frames.png`));
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.length);
    this.part("scrub").value = this.time;
    this.paint();
  }

  paint() {
    if (!this.scenes) return;
    if (this.scenes[0]) this.angle = this.scenes[0].angle;
    this.scenes.forEach((scene) => scene.draw(this.time));
    drawClearance(this.part("plot"), this);
    const seconds = (this.time * this.task.dt).toFixed(2);
    const clearances = this.scenes.map(({ episode, data }) => {
      const step = Math.min(Math.floor(this.time + 1e-6), episode.steps), least = data.clearance(step)[0];
      return `${this.task.agents[episode.agent].label} ${metres(least)}`;
    });
    this.part("now").textContent = `${seconds} s · clearance: ${clearances.join(", ")}`;
    this.part("scrub").setAttribute("aria-valuetext", `${seconds} seconds`);
  }

  toggle() {
    this.playing = !this.playing;
    this.part("play").textContent = this.playing ? "Pause" : "Play";
    if (!this.playing) return;
    if (this.time >= this.length) this.time = 0;
    let before = null;
    const frame = (now) => {
      if (!this.playing) return;
      this.seek(this.time + (before === null ? 0 : ((now - before) / 1000 / this.task.dt) * this.speed));
      before = now;
      if (this.time >= this.length) this.toggle();
      else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  key(event) {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = Math.round(this.time), place = this.rows.findIndex((row) => row.scenario === this.scenario);
    const to = (n) => () => this.rows[n] && this.watch(this.rows[n].scenario);
    const keys = {
      " ": () => this.toggle(), ArrowLeft: () => this.seek(step - 1), ArrowRight: () => this.seek(step + 1),
      Home: () => this.seek(0), End: () => this.seek(this.length), ArrowUp: to(place - 1), ArrowDown: to(place + 1),
    };
    const pressed = event.target.tagName === "BUTTON" && event.key === " " ? null : keys[event.key];
    if (!pressed) return;
    event.preventDefault();
    pressed();
  }

  plotTime(event) {
    const box = this.part("plot").getBoundingClientRect();
    return (this.length * (event.clientX - box.left - PLOT.left)) / (box.width - PLOT.left - PLOT.right);
  }
}

function cell(tag, words) {
  const made = document.createElement(tag);
  made.textContent = words;
  if (tag === "th") made.scope = "col";
  return made;
}

// A command that breaks between its words alone: browsers break lines after the dashes of an option, too.
function unbroken(command) {
  return command.trim().split(" ").flatMap((word) => {
    const made = document.createElement("span");
    made.textContent = word;
    return [made, " "];
  });
}

function mark(why) {
  const made = document.createElement("small");
  made.textContent = why;
  return made;
}

// How an episode ended, in a cell: the mark and the word say it without the colour.
function result(episode) {
  const made = cell("td", "");
  if (!episode) return made;
  const word = document.createElement("span"), least = document.createElement("small");
  word.className = kind(episode);
  word.textContent = words[kind(episode)];
  least.textContent = metres(episode.least);
  made.append(word, least);
  return made;
}

// Of small numbers more digits: a touch must not read as "−0.00".
function metres(value) {
  const size = Math.abs(value), digits = size < 0.001 ? 4 : size < 0.1 ? 3 : 2;
  return `${value < 0 ? "−" : ""}${size.toFixed(digits)}\u00a0m`;
}
const words = { bad: "✕ collision", good: "✓ reached", fair: "– not reached" };
const kind = (episode) => (episode.cost > 0 ? "bad" : episode.arrived ? "good" : "fair");
const outcome = (episode) => `${words[kind(episode)]}, ${metres(episode.least)}`;

const PLOT = { left: 44, right: 12, top: 14, bottom: 24 };

// Clearance against time of all episodes that are shown, and where the time stands.
function drawClearance(canvas, explorer) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const c = canvas.getContext("2d"), { task, scenes, length } = explorer;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const values = scenes.map(({ episode, data }) => Array.from({ length: episode.steps + 1 }, (_, t) => data.clearance(t)[0]));
  const all = values.flat(), least = Math.min(0, ...all), most = Math.max(0.05, ...all), room = 0.06 * (most - least);
  const x = (t) => PLOT.left + ((width - PLOT.left - PLOT.right) * t) / length;
  const y = (v) => height - PLOT.bottom - ((height - PLOT.top - PLOT.bottom) * (v - least + room)) / (most - least + 2 * room);
  c.font = "12px system-ui, sans-serif";
  c.fillStyle = colour("bad-fill");
  c.fillRect(PLOT.left, y(0), width - PLOT.left - PLOT.right, height - PLOT.bottom - y(0));
  c.textAlign = "right";
  c.textBaseline = "middle";
  for (const value of ticks(least, most)) {
    c.strokeStyle = value ? colour("grid") : colour("faint");
    c.lineWidth = 1;
    line(c, [PLOT.left, y(value)], [width - PLOT.right, y(value)]);
    c.fillStyle = colour("faint");
    c.fillText(String(value).replace("-", "−"), PLOT.left - 6, y(value));
  }
  c.textAlign = "right";
  c.textBaseline = "top";
  c.fillText("clearance, m", width - PLOT.right, 0);
  c.textBaseline = "middle";
  c.textAlign = "center";
  for (const value of ticks(0, length * task.dt)) {
    const words = `${value} s`, inside = width - c.measureText(words).width / 2;
    c.fillText(words, Math.min(x(value / task.dt), inside), height - PLOT.bottom + 12);
  }
  scenes.forEach((scene, n) => {
    c.strokeStyle = scene.robot;
    c.lineWidth = 2;
    c.setLineDash(n ? [6, 3] : []);
    c.beginPath();
    values[n].forEach((value, t) => c.lineTo(x(t), y(value)));
    c.stroke();
    c.setLineDash([]);
    const step = Math.min(Math.floor(explorer.time + 1e-6), scene.episode.steps);
    disc(c, [x(step), y(values[n][step])], 4, scene.robot, colour("card"), 1.5);
  });
  c.strokeStyle = colour("ink");
  c.lineWidth = 1;
  line(c, [x(explorer.time), PLOT.top], [x(explorer.time), height - PLOT.bottom]);
}

// Round numbers from low to high, about five.
function ticks(low, high) {
  const raw = (high - low) / 5, unit = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((n) => n * unit).find((n) => n >= raw), found = [];
  for (let n = Math.ceil(low / step); n * step <= high; n++) found.push(Number((n * step).toPrecision(6)));
  return found;
}
