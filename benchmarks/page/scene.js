"use strict";
// How an episode looks at a moment: the plane from above, space from a camera that a drag turns.

const DISC_ARROW = 2, ROBOT_ARROW = { 2: 1, 3: 0.2 }; // s: arrows show where things would go in this time

class Scene {
  constructor(canvas, task, colourOfRobot) {
    Object.assign(this, { canvas, task, paint: colourOfRobot, context: canvas.getContext("2d") });
    this.angle = { turn: -0.62, rise: 0.42 };
    if (task.dim === 3) this.orbit();
  }

  get robot() { return seen(this.paint); }

  show(episode, data, bounds) {
    Object.assign(this, { episode, data, bounds });
    this.canvas.setAttribute("aria-label", `${this.task.label}, scenario ${episode.scenario}`);
    return this;
  }

  orbit() {
    const { canvas } = this;
    let from = null;
    canvas.classList.add("orbit");
    canvas.addEventListener("pointerdown", (event) => {
      from = { x: event.clientX, y: event.clientY, ...this.angle };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      const rise = from.rise + (event.clientY - from.y) / 150;
      const angle = { turn: from.turn - (event.clientX - from.x) / 150, rise: Math.min(1.5, Math.max(0.02, rise)) };
      this.turned(angle);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (from = null));
  }

  turned(angle) { // replaced by who wants to turn other scenes as well
    this.angle = angle;
    this.draw(this.time);
  }

  resize() {
    const ratio = window.devicePixelRatio || 1, width = this.canvas.clientWidth;
    const height = this.task.dim === 3 ? width * 0.8 : width;
    this.canvas.style.height = `${height}px`;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(this, { width, height });
  }

  draw(time) {
    this.time = time;
    this.resize();
    const last = this.episode.steps, t = Math.min(time, last), step = Math.min(Math.floor(t + 1e-6), last);
    const now = (name) => between(this.data[name], t, last);
    const moment = {
      t, step, position: now("position"), heading: now("heading")[0], true: now("true"),
      reading: this.data.reading(step), hit: this.data.cost(Math.min(step, last - 1))[0] > 0,
      body: this.data.body && now("body"),
    };
    (this.task.dim === 3 ? drawSpace : drawPlane)(this, moment);
  }

  // Centre, velocity and radius of each obstacle in a reading.
  balls(reading) {
    const { dim, obstacles } = this.task, size = 2 * dim + 1, list = [];
    for (let n = 0; n < obstacles; n++) {
      const part = Array.from(reading.subarray(n * size, (n + 1) * size));
      list.push({ center: part.slice(0, dim), velocity: part.slice(dim, 2 * dim), radius: part[2 * dim] });
    }
    return list;
  }

  velocity(moment) {
    const b = Math.min(moment.step + 1, this.episode.steps), a = Math.max(0, b - 1);
    const to = this.data.position(b), from = this.data.position(a);
    return Array.from(to, (value, i) => (value - from[i]) / this.task.dt);
  }
}

// --- the plane ----------------------------------------------------------------------------------------------------

function drawPlane(scene, moment) {
  const { context: c, task, width, bounds } = scene;
  const centre = bounds.low.map((value, i) => (value + bounds.high[i]) / 2);
  const half = 0.52 * Math.max(...minus(bounds.high, bounds.low)) + task.robotRadius, scale = width / (2 * half);
  const at = ([x, y]) => [(x - centre[0] + half) * scale, (half - y + centre[1]) * scale];
  c.fillStyle = colour("outside");
  c.fillRect(0, 0, width, width);
  const [left, top] = at([task.low[0], task.high[1]]), [right, bottom] = at([task.high[0], task.low[1]]);
  c.fillStyle = colour("floor");
  c.fillRect(left, top, right - left, bottom - top);
  for (let metre = Math.ceil(task.low[0]); metre <= task.high[0]; metre++) {
    c.strokeStyle = colour(metre % 5 ? "grid" : "line");
    c.lineWidth = metre % 5 ? 0.5 : 0.8;
    line(c, at([metre, task.low[1]]), at([metre, task.high[1]]));
    line(c, at([task.low[0], metre]), at([task.high[0], metre]));
  }
  const goal = task.scenarios[scene.episode.scenario].goal;
  disc(c, at(goal), task.goalRadius * scale, colour("goal-fill"), colour("goal"));
  disc(c, at(goal), 2.5, colour("goal"));
  drawPath(c, scene, moment, at);
  disc(c, at(scene.data.position(0)), 4, colour("floor"), colour("faint"));
  for (const ball of scene.balls(moment.true)) {
    disc(c, at(ball.center), ball.radius * scale, colour("obstacle"), colour("obstacle-rim"));
    arrow(c, at(ball.center), at(plus(ball.center, ball.velocity, DISC_ARROW)), colour("obstacle-rim"), 2);
  }
  drawVehicle(c, scene, moment, at, scale);
  for (const ball of scene.balls(moment.reading)) {
    const center = at(ball.center);
    c.setLineDash([5, 4]);
    if (ball.radius > 0) disc(c, center, ball.radius * scale, null, colour("reading"), 2);
    arrow(c, center, at(plus(ball.center, ball.velocity, DISC_ARROW)), colour("reading"), 2);
    c.setLineDash([]);
    cross(c, center, 4, colour("reading"));
  }
}

function drawVehicle(c, scene, moment, at, scale) {
  const radius = scene.task.robotRadius * scale, [x, y] = at(moment.position);
  if (moment.hit) disc(c, [x, y], radius + 5, null, colour("bad"), 3);
  disc(c, [x, y], radius, scene.robot, colour("ink"), 1);
  c.fillStyle = "#fff";
  c.beginPath();
  for (const [turn, reach] of [[0, 0.82], [2.45, 0.72], [Math.PI, 0.28], [-2.45, 0.72]]) {
    const angle = moment.heading + turn;
    c.lineTo(x + radius * reach * Math.cos(angle), y - radius * reach * Math.sin(angle));
  }
  c.fill();
  const tip = at(plus(Array.from(moment.position), scene.velocity(moment), ROBOT_ARROW[2]));
  const way = minus(tip, [x, y]), length = Math.hypot(...way);
  if (length > radius) arrow(c, plus([x, y], way, radius / length), tip, colour("motion"), 2.5); // the wedge stays visible
}

function drawPath(c, scene, moment, at) {
  const points = [];
  for (let t = 0; t <= scene.episode.steps; t++) points.push(at(scene.data.position(t)));
  const here = at(moment.position), before = points.slice(0, moment.step + 1).concat([here]);
  for (const [list, alpha] of [[[here].concat(points.slice(moment.step + 1)), 0.5], [before, 1]]) {
    c.globalAlpha = alpha;
    c.strokeStyle = scene.robot;
    c.lineWidth = 2.2;
    c.lineJoin = "round";
    c.beginPath();
    for (const point of list) c.lineTo(...point);
    c.stroke();
  }
  c.globalAlpha = 1;
}

// --- space --------------------------------------------------------------------------------------------------------

class Camera {
  constructor(scene) {
    const { low, high } = scene.bounds;
    const centre = low.map((value, i) => (value + high[i]) / 2), { turn, rise } = scene.angle;
    const size = Math.hypot(...low.map((value, i) => high[i] - value));
    centre[2] -= 0.06 * size; // the table in front needs room
    const back = [Math.cos(turn) * Math.cos(rise), Math.sin(turn) * Math.cos(rise), Math.sin(rise)];
    const right = [-Math.sin(turn), Math.cos(turn), 0], up = cross3(back, right);
    Object.assign(this, { eye: plus(centre, back, 1.4 * size), right, up, back, scene, low, high });
    this.focal = 1.5 * Math.min(scene.width, scene.height / 0.8);
  }

  depth(p) { return -dot(minus(p, this.eye), this.back); }

  at(p) {
    const local = minus(p, this.eye), depth = -dot(local, this.back);
    const { width, height } = this.scene, scale = this.focal / Math.max(depth, 0.05);
    return [width / 2 + scale * dot(local, this.right), height / 2 - scale * dot(local, this.up)];
  }

  size(length, p) { return (length * this.focal) / Math.max(this.depth(p), 0.05); }
}

function drawSpace(scene, moment) {
  const { context: c, task, width, height } = scene, eye = new Camera(scene);
  const at = (p) => eye.at(Array.from(p));
  c.fillStyle = colour("outside");
  c.fillRect(0, 0, width, height);
  drawTable(c, eye);
  const goal = task.scenarios[scene.episode.scenario].goal, balls = scene.balls(moment.true);
  for (const ball of balls) shadow(c, eye, ball.center, ball.radius, 0.22);
  shadow(c, eye, goal, task.goalRadius, 0.12);
  for (const part of capsules(task, moment.body)) shadow(c, eye, plus(scaled(part.a, 0.5), part.b, 0.5), part.radius, 0.04);
  const things = [];
  const put = (p, paint) => things.push({ depth: eye.depth(p), paint });
  for (const part of capsules(task, moment.body)) {
    put(plus(scaled(part.a, 0.5), part.b, 0.5), () => capsule(c, eye, part));
  }
  if (!moment.body) put(Array.from(moment.position), () => ball3(c, at(moment.position), eye.size(task.robotRadius, moment.position), scene.robot));
  for (const ball of balls) {
    put(ball.center, () => ball3(c, at(ball.center), eye.size(ball.radius, ball.center), colour("obstacle")));
  }
  put(goal, () => ball3(c, at(goal), eye.size(0.4 * task.goalRadius, goal), colour("goal")));
  things.sort((a, b) => b.depth - a.depth).forEach((thing) => thing.paint());
  drawOverlay(c, scene, moment, eye, at, goal, balls);
}

function drawOverlay(c, scene, moment, eye, at, goal, balls) {
  const { task } = scene;
  c.globalAlpha = 0.25;
  disc(c, at(goal), eye.size(task.goalRadius, goal), colour("goal"));
  c.globalAlpha = 1;
  disc(c, at(goal), eye.size(task.goalRadius, goal), null, colour("goal"), 1.5);
  drawPath(c, scene, moment, at);
  for (const ball of balls) {
    if (moment.hit) disc(c, at(ball.center), eye.size(ball.radius, ball.center) + 4, null, colour("bad"), 3);
    arrow(c, at(ball.center), at(plus(ball.center, ball.velocity, DISC_ARROW)), colour("obstacle-rim"), 2);
  }
  for (const ball of scene.balls(moment.reading)) {
    const size = eye.size(Math.max(ball.radius, 0), ball.center);
    c.globalAlpha = 0.22;
    disc(c, at(ball.center), size, colour("reading"));
    c.globalAlpha = 1;
    c.setLineDash([5, 4]);
    disc(c, at(ball.center), size, null, colour("reading"), 2);
    arrow(c, at(ball.center), at(plus(ball.center, ball.velocity, DISC_ARROW)), colour("reading"), 2);
    c.setLineDash([]);
    cross(c, at(ball.center), 4, colour("reading"));
  }
  const hand = Array.from(moment.position), tip = plus(hand, scene.velocity(moment), ROBOT_ARROW[3]);
  disc(c, at(hand), 3.5, scene.robot, "#fff", 1);
  arrow(c, at(hand), at(tip), colour("motion"), 2.5);
}

function drawTable(c, eye) {
  const x = [eye.low[0] - 0.15, eye.high[0] + 0.1], y = [eye.low[1] - 0.05, eye.high[1] + 0.05];
  c.fillStyle = colour("floor");
  c.strokeStyle = colour("line");
  c.lineWidth = 1;
  polygon(c, [[x[0], y[0], 0], [x[1], y[0], 0], [x[1], y[1], 0], [x[0], y[1], 0]].map((p) => eye.at(p)));
  c.fill();
  c.stroke();
  c.strokeStyle = colour("grid");
  for (let k = Math.ceil(10 * x[0]); k <= 10 * x[1]; k++) line(c, eye.at([k / 10, y[0], 0]), eye.at([k / 10, y[1], 0]));
  for (let k = Math.ceil(10 * y[0]); k <= 10 * y[1]; k++) line(c, eye.at([x[0], k / 10, 0]), eye.at([x[1], k / 10, 0]));
}

function capsules(task, body) {
  if (!body) return [];
  return task.radii.map((radius, k) => {
    const ends = Array.from(body.subarray(6 * k, 6 * k + 6));
    return { a: ends.slice(0, 3), b: ends.slice(3), radius };
  });
}

function capsule(c, eye, { a, b, radius }) {
  const from = eye.at(a), to = eye.at(b), middle = plus(scaled(a, 0.5), b, 0.5), size = eye.size(radius, middle);
  const along = minus(to, from), length = Math.hypot(...along) || 1;
  let side = [-along[1] / length, along[0] / length];
  if (side[0] * -0.5 + side[1] * -0.8 < 0) side = scaled(side, -1); // the light comes from the upper left
  const centre = plus(scaled(from, 0.5), to, 0.5);
  const shade = c.createLinearGradient(...plus(centre, side, size), ...plus(centre, side, -size));
  ["arm-light", "arm", "arm-dark"].forEach((name, i) => shade.addColorStop(i / 2, colour(name)));
  c.lineCap = "round";
  for (const [paint, wide] of [[colour("arm-line"), 2 * size + 1.2], [shade, 2 * size]]) {
    c.strokeStyle = paint;
    c.lineWidth = wide;
    line(c, from, length > 1 ? to : plus(from, [0.01, 0], 1));
  }
  c.lineCap = "butt";
}

function ball3(c, [x, y], radius, paint) {
  const shade = c.createRadialGradient(x - 0.35 * radius, y - 0.4 * radius, 0, x, y, radius);
  shade.addColorStop(0, "#ffffffb0");
  shade.addColorStop(0.45, "#ffffff10");
  shade.addColorStop(1, "#00000048");
  disc(c, [x, y], radius, paint);
  disc(c, [x, y], radius, shade);
}

function shadow(c, eye, [x, y], radius, alpha) {
  c.fillStyle = `rgba(0, 0, 0, ${alpha})`;
  const points = Array.from({ length: 24 }, (_, i) => (i * Math.PI) / 12);
  polygon(c, points.map((turn) => eye.at([x + radius * Math.cos(turn), y + radius * Math.sin(turn), 0])));
  c.fill();
}
