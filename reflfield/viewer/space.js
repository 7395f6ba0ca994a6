// Vectors, 4 x 4 matrices (column by column, as WebGL takes them) and cameras.
//
// Everything that is drawn lives in the frame of the mesh: the middle of its box at the origin,
// its farthest vertex at distance 1. A camera is given as calibrated ones are: a rotation and a
// translation to axes right, down, forward, focal lengths and principal point in pixels, the
// centre of the top-left pixel at (0.5, 0.5).

const minus = (a, b) => a.map((value, i) => value - b[i]);
const plus = (a, b) => a.map((value, i) => value + b[i]);
const times = (a, factor) => a.map((value) => value * factor);
const dot = (a, b) => a.reduce((total, value, i) => total + value * b[i], 0);
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

// Vector rotated about a unit axis.
function rotated(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(vector, axis) * (1 - c);
  const across = cross(axis, vector);
  return vector.map((value, i) => c * value + s * across[i] + along * axis[i]);
}

function multiplied(a, b) {
  const out = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      let total = 0;
      for (let k = 0; k < 4; k++) total += a[4 * k + row] * b[4 * column + k];
      out[4 * column + row] = total;
    }
  }
  return out;
}

// Matrix of rows; the last one defaults to (0, 0, 0, 1).
function matrixOfRows(rows) {
  const all = rows.length === 4 ? rows : [...rows, [0, 0, 0, 1]];
  return Float32Array.from({ length: 16 }, (_, i) => all[i % 4][Math.floor(i / 4)]);
}

// Rows right, down, forward of a camera at `eye` that looks at `target`.
function lookingAt(eye, target, up) {
  const forward = unit(minus(target, eye));
  let right = cross(forward, up);
  if (Math.hypot(...right) < 1e-6) right = cross(forward, [up[1], up[2], up[0]]);
  right = unit(right);
  return [right, cross(forward, right), forward];
}

// A camera of the page: `rows` and `eye` in the mesh's frame, intrinsics in pixels.
function makeCamera({ rows, eye, width, height, focal, centre, parallel = false }) {
  const depth = -dot(rows[2], eye), far = depth + 1.02;
  const near = parallel ? depth - 1.02 : Math.max(depth - 1.02, 0.004 * Math.max(depth, 0.25));
  return { rows, eye, width, height, focal, centre, parallel, near, far: Math.max(far, near * 1.1) };
}

// Clip space from the mesh's frame; the image is moved by (dx, dy) pixels.
function clipFromWorld(camera, dx = 0, dy = 0) {
  const { rows, eye, width, height, focal, near, far } = camera;
  const view = matrixOfRows(rows.map((row) => [...row, -dot(row, eye)]));
  const x = 2 * (camera.centre[0] + dx) / width - 1, y = 1 - 2 * (camera.centre[1] + dy) / height;
  const sx = 2 * focal[0] / width, sy = -2 * focal[1] / height, range = far - near;
  const projection = camera.parallel
    ? [[sx, 0, 0, x], [0, sy, 0, y], [0, 0, 2 / range, -(far + near) / range], [0, 0, 0, 1]]
    : [[sx, 0, x, 0], [0, sy, y, 0], [0, 0, (far + near) / range, -2 * far * near / range],
      [0, 0, 1, 0]];
  return multiplied(matrixOfRows(projection), view);
}

// Camera of a calibrated photograph, in the frame of a mesh.
function calibratedCamera(given, surface) {
  const m = given.camera_from_world, rows = m.slice(0, 3).map((row) => row.slice(0, 3));
  const world = [0, 1, 2].map((axis) => -rows.reduce((sum, row, k) => sum + row[axis] * m[k][3], 0));
  const parallel = given.kind === "orthographic", scale = parallel ? surface.radius : 1;
  let eye = times(minus(world, surface.centre), 1 / surface.radius);
  // Parallel rays have no start of their own.
  if (parallel) eye = minus(eye, times(rows[2], dot(rows[2], eye) + 2));
  return makeCamera({
    rows, eye, parallel, width: given.width, height: given.height,
    focal: [given.fl_x * scale, given.fl_y * scale], centre: [given.cx, given.cy],
  });
}

// Left, top, width and height of an image fitted into a part of a window.
function fittedBox(size, free) {
  const scale = Math.min(free[2] / size[0], free[3] / size[1]), [w, h] = times(size, scale);
  return [free[0] + 0.5 * (free[2] - w), free[1] + 0.5 * (free[3] - h), w, h];
}

// The same camera with its image fitted into the free part of a window.
function fittedCamera(camera, { width, height, free }) {
  const [left, top, across] = fittedBox([camera.width, camera.height], free);
  const scale = across / camera.width;
  return makeCamera({
    ...camera, width, height, focal: times(camera.focal, scale),
    centre: [left + scale * camera.centre[0], top + scale * camera.centre[1]],
  });
}

// Axes that orbits turn about: up, and the direction that azimuth 0 looks from. A closed object
// stands upright; a flat one is seen from its front.
function orbitFrame(up, facing) {
  const flatness = Math.hypot(...facing);
  let axis = unit(up), front;
  if (flatness > 0.5) {
    front = unit(facing);
    if (Math.abs(dot(axis, front)) > 0.9) axis = Math.abs(front[1]) > 0.9 ? [0, 0, 1] : [0, 1, 0];
    axis = unit(minus(axis, times(front, dot(axis, front))));
  } else {
    const least = axis.map(Math.abs).indexOf(Math.min(...axis.map(Math.abs)));
    const ahead = [0, 1, 2].map((i) => (i === least ? 1 : 0));
    front = unit(minus(ahead, times(axis, dot(ahead, axis))));
  }
  return { up: axis, front, left: cross(axis, front), isFlat: flatness > 0.5 };
}

// Unit vector at an azimuth and an elevation, radians.
function directionAt(frame, azimuth, elevation) {
  const c = Math.cos(elevation);
  return [0, 1, 2].map((i) => c * Math.cos(azimuth) * frame.front[i] +
    c * Math.sin(azimuth) * frame.left[i] + Math.sin(elevation) * frame.up[i]);
}

// Azimuth and elevation of a direction.
function anglesOf(frame, direction) {
  const d = unit(direction);
  return [
    Math.atan2(dot(d, frame.left), dot(d, frame.front)),
    Math.asin(clamp(dot(d, frame.up), -1, 1)),
  ];
}

// Matrix and kind of a lamp's shadow map: what the lamp sees of the unit sphere.
function lampCamera(lamp) {
  const across = Math.abs(lamp.at[2]) > 0.9 * Math.hypot(...lamp.at) ? [1, 0, 0] : [0, 0, 1];
  if (!lamp.isPoint) {
    const rows = lookingAt(times(lamp.at, 2), [0, 0, 0], across);
    return makeCamera({
      rows, eye: times(lamp.at, 2), width: 2, height: 2, focal: [0.99, 0.99], centre: [1, 1],
      parallel: true,
    });
  }
  const distance = Math.hypot(...lamp.at), rows = lookingAt(lamp.at, [0, 0, 0], across);
  const focal = 0.99 * Math.sqrt(Math.max(distance * distance - 1, 0.02));
  return makeCamera({
    rows, eye: lamp.at, width: 2, height: 2, focal: [focal, focal], centre: [1, 1],
  });
}
