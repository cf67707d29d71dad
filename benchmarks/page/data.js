"use strict";
// What the page carries: bytes in base64 under gzip, unpacked by the browser itself.

async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

async function text(id) {
  return new TextDecoder().decode(await unpacked(id));
}

// The numbers of one episode by name, each with values(t): see benchmarks/explorer.py, which encodes them.
function decoded(task, episode, numbers) {
  const rows = episode.steps + 1, found = {};
  let at = episode.at;
  for (const { name, width, scale } of task.parts) {
    const steps = new Int16Array(numbers.buffer, at, rows * width), all = new Float32Array(rows * width);
    for (let c = 0; c < width; c++) {
      for (let t = 0, whole = 0; t < rows; t++) {
        whole = ((whole + steps[c * rows + t]) << 16) >> 16;
        all[t * width + c] = whole * scale;
      }
    }
    found[name] = (t) => all.subarray(t * width, (t + 1) * width);
    at += 2 * rows * width;
  }
  return found;
}

// The value of `at` between two steps; `t` in steps.
function between(at, t, last) {
  const low = Math.min(Math.floor(t), last), share = Math.min(t, last) - low;
  if (!share) return at(low);
  const a = at(low), b = at(low + 1);
  return a.map((value, i) => value + share * (b[i] - value));
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}
