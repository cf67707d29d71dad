"use strict";
// Vectors, and what canvases are drawn with; points are pixels [x, y].

const plus = (a, b, times) => a.map((value, i) => value + times * b[i]);
const minus = (a, b) => a.map((value, i) => value - b[i]);
const scaled = (a, times) => a.map((value) => times * value);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const cross3 = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

const dark = matchMedia("(prefers-color-scheme: dark)");

// A colour "#rrggbb" that is seen on the page: on a dark one those that are dark themselves are mixed with white.
function seen(paint) {
  if (!dark.matches || !/^#[0-9a-f]{6}$/i.test(paint ?? "")) return paint;
  const parts = [1, 3, 5].map((i) => parseInt(paint.slice(i, i + 2), 16) / 255);
  const light = dot(parts, [0.3, 0.6, 0.1]), white = Math.max(0, (0.55 - light) / (1 - light));
  return `rgb(${parts.map((part) => Math.round(255 * (part + white * (1 - part)))).join(" ")})`;
}

function line(c, a, b) {
  c.beginPath();
  c.moveTo(...a);
  c.lineTo(...b);
  c.stroke();
}

function polygon(c, points) {
  c.beginPath();
  for (const point of points) c.lineTo(...point);
  c.closePath();
}

function disc(c, [x, y], radius, fill, rim, width = 1.5) {
  c.beginPath();
  c.arc(x, y, Math.max(radius, 0), 0, 2 * Math.PI);
  if (fill) {
    c.fillStyle = fill;
    c.fill();
  }
  if (rim) {
    c.strokeStyle = rim;
    c.lineWidth = width;
    c.stroke();
  }
}

function cross(c, [x, y], size, paint) {
  c.strokeStyle = paint;
  c.lineWidth = 2;
  line(c, [x - size, y - size], [x + size, y + size]);
  line(c, [x - size, y + size], [x + size, y - size]);
}

function arrow(c, from, to, paint, width) {
  const along = minus(to, from), length = Math.hypot(...along);
  if (length < 6) return;
  const ahead = scaled(along, 1 / length), side = [-ahead[1], ahead[0]], head = Math.min(4 + 2.2 * width, 0.8 * length);
  const neck = plus(to, ahead, -head);
  c.strokeStyle = c.fillStyle = paint;
  c.lineWidth = width;
  line(c, from, neck);
  polygon(c, [to, plus(neck, side, head / 2), plus(neck, side, -head / 2)]);
  c.fill();
}
