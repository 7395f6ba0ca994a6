// Environment maps: two that are computed, files that are dropped, and the few directional
// lights that stand for a map. A map is a latitude-longitude image, row 0 at the zenith, in the
// convention of OpenEXR (reflfield/render/map_directions.py): +Y up, its middle is +Z.

const LARGEST_MAP_ROWS = 64;  // maps are averaged down to so many rows before they are cut

function madeMap(height, radianceAt) {
  const width = 2 * height, values = new Float32Array(3 * width * height);
  for (let row = 0; row < height; row++) {
    for (let column = 0; column < width; column++) {
      const azimuth = 360 * (column + 0.5) / width - 180, elevation = 90 - 180 * (row + 0.5) / height;
      values.set(radianceAt(azimuth, elevation), 3 * (row * width + column));
    }
  }
  return { width, height, values };
}

const between = (value, low, high) => clamp((value - low) / (high - low), 0, 1);

// Share of a soft-edged rectangle of light, degrees.
function softbox(azimuth, elevation, [a, e, halfWidth, halfHeight]) {
  const across = Math.abs(((azimuth - a + 540) % 360) - 180);
  return (1 - between(across, halfWidth, halfWidth + 4)) *
    (1 - between(Math.abs(elevation - e), halfHeight, halfHeight + 4));
}

const MAPS = {
  // A large warm light to the left, a narrow cool one to the right, a weak one above.
  studio: () => madeMap(64, (azimuth, elevation) => {
    const key = 9 * softbox(azimuth, elevation, [-50, 32, 22, 16]);
    const rim = 7 * softbox(azimuth, elevation, [115, 20, 7, 30]);
    const top = 1.6 * softbox(azimuth, elevation, [0, 82, 180, 10]);
    const room = 0.10 + 0.06 * Math.sin(elevation * Math.PI / 180);
    return [key + 0.82 * rim + top + room, 0.93 * key + 0.93 * rim + top + room,
      0.82 * key + rim + top + 1.05 * room];
  }),
  // A low sun in a blue sky over grey ground.
  sky: () => madeMap(64, (azimuth, elevation) => {
    if (elevation < 0) return [0.20, 0.18, 0.16];
    const height = Math.sin(elevation * Math.PI / 180), away = 1 - height;
    const apart = Math.hypot((azimuth - 40) * Math.cos(0.6), elevation - 34);
    const sun = 260 * (1 - between(apart, 3, 5)), glow = 1.2 * Math.exp(-apart / 14);
    return [sun + glow + 0.25 + 0.45 * away ** 3, 0.92 * sun + 0.9 * glow + 0.42 + 0.35 * away ** 3,
      0.78 * sun + 0.6 * glow + 0.85];
  }),
};

// Directions (map's frame), irradiances and weights of a map's pixels, averaged down.
function mapPixels(map) {
  const step = Math.ceil(map.height / LARGEST_MAP_ROWS), rows = Math.ceil(map.height / step);
  const columns = Math.ceil(map.width / step);
  const pixels = Array.from({ length: rows * columns }, () => new Float64Array(7));
  for (let y = 0; y < map.height; y++) {
    const theta = Math.PI * (y + 0.5) / map.height;
    const solidAngle = (Math.cos(Math.PI * y / map.height) -
      Math.cos(Math.PI * (y + 1) / map.height)) * 2 * Math.PI / map.width;
    for (let x = 0; x < map.width; x++) {
      const phi = 2 * Math.PI * (x + 0.5) / map.width, at = 3 * (y * map.width + x);
      const pixel = pixels[Math.floor(y / step) * columns + Math.floor(x / step)];
      const rgb = [0, 1, 2].map((c) => Math.max(map.values[at + c], 0) * solidAngle);
      const weight = luminance(rgb) + 1e-12 * solidAngle;
      rgb.forEach((value, c) => { pixel[c] += value; });
      pixel[3] += weight * Math.sin(phi) * Math.sin(theta);
      pixel[4] += weight * Math.cos(theta);
      pixel[5] -= weight * Math.cos(phi) * Math.sin(theta);
      pixel[6] += weight;
    }
  }
  return pixels.map((p) => ({
    power: [p[0], p[1], p[2]], at: unit([p[3], p[4], p[5]]), weight: p[6],
  }));
}

const luminance = (rgb) => 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];

// Spread of a cell's energy along each axis, and its mean: render/distant_lights.py.
function spreadOf(cell) {
  const sums = [0, 0, 0], squares = [0, 0, 0];
  let weight = 0;
  for (const pixel of cell) {
    weight += pixel.weight;
    for (let a = 0; a < 3; a++) {
      sums[a] += pixel.weight * pixel.at[a];
      squares[a] += pixel.weight * pixel.at[a] ** 2;
    }
  }
  const mean = sums.map((sum) => sum / weight);
  const spread = squares.map((square, a) => Math.max(square - weight * mean[a] ** 2, 0));
  return { cell, mean, spread, error: spread[0] + spread[1] + spread[2] };
}

// Few directional lights that together send what the pixels send: the cell that errs most is
// cut at its mean until there are enough.
function mergedLights(pixels, nLights) {
  const cells = [spreadOf(pixels)];
  while (cells.length < nLights) {
    const worst = cells.reduce((best, one, i) => (one.error > cells[best].error ? i : best), 0);
    const { cell, mean, spread, error } = cells[worst];
    const axis = spread.indexOf(Math.max(...spread));
    const upper = cell.filter((pixel) => pixel.at[axis] > mean[axis]);
    if (!(error > 0) || !upper.length || upper.length === cell.length) break;
    const lower = cell.filter((pixel) => !(pixel.at[axis] > mean[axis]));
    cells.splice(worst, 1, spreadOf(lower), spreadOf(upper));
  }
  return cells.map(({ cell, mean }) => ({
    at: unit(mean), isPoint: false,
    power: [0, 1, 2].map((c) => cell.reduce((sum, pixel) => sum + pixel.power[c], 0)),
  }));
}

// Rotation of a map's frame (+Y up) into the world: the shortest one to `up`, then about it.
function mapToWorld(up, angle) {
  const y = [0, 1, 0], axis = cross(y, up), sine = Math.hypot(...axis);
  return (direction) => {
    let turned = direction;
    if (sine > 1e-9) turned = rotated(direction, unit(axis), Math.atan2(sine, up[1]));
    else if (up[1] < 0) turned = rotated(direction, [1, 0, 0], Math.PI);
    return rotated(turned, up, angle);
  };
}

// --- files ---------------------------------------------------------------------------------

const FORMATS_READ = "Radiance HDR (.hdr), OpenEXR (.exr: scan lines, uncompressed or ZIP), " +
  "PNG, JPEG or WebP";

// Map of a file's content.
async function readMap(file) {
  const bytes = new Uint8Array(await file.arrayBuffer()), name = file.name.toLowerCase();
  const isExr = bytes[0] === 0x76 && bytes[1] === 0x2f && bytes[2] === 0x31 && bytes[3] === 0x01;
  let map;
  try {
    if (isExr) map = await readExr(bytes);
    else if (name.endsWith(".hdr") || String.fromCharCode(bytes[0], bytes[1]) === "#?") {
      map = readHdr(bytes);
    } else map = await readPicture(file);
  } catch (error) {
    const why = error instanceof PageError ? ` (${error.message})` : "";
    throw new PageError(`${file.name} cannot be read as an environment map${why}. ` +
      `What is read: ${FORMATS_READ}.`);
  }
  if (Math.abs(map.width - 2 * map.height) > Math.max(1, 0.01 * map.width)) {
    throw new PageError(`${file.name}: expected a latitude-longitude map, twice as wide as ` +
      `high, received ${map.width} x ${map.height} pixels.`);
  }
  return map;
}

// A picture of 8 bits, decoded by the browser; its values are sRGB.
async function readPicture(file) {
  const bitmap = await createImageBitmap(file);
  const scale = Math.min(1, 512 / bitmap.height);
  const width = Math.max(1, Math.round(bitmap.width * scale));
  const height = Math.max(1, Math.round(bitmap.height * scale));
  const context = Object.assign(document.createElement("canvas"), { width, height })
    .getContext("2d");
  context.drawImage(bitmap, 0, 0, width, height);
  const codes = context.getImageData(0, 0, width, height).data;
  const values = new Float32Array(3 * width * height);
  for (let i = 0; i < values.length; i++) {
    const code = codes[Math.floor(i / 3) * 4 + i % 3] / 255;
    values[i] = code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4;
  }
  return { width, height, values };
}

const MOST_MAP_PIXELS = 1 << 26;

function checkedSize(width, height) {
  if (!(width > 0 && height > 0 && width * height <= MOST_MAP_PIXELS)) {
    throw new PageError(`its size of ${width} x ${height} pixels is beyond what is read`);
  }
}

// Radiance HDR, flat or run-length coded, rows from the top.
function readHdr(bytes) {
  let at = 0;
  const line = () => {
    const start = at;
    while (at < bytes.length && bytes[at] !== 10) at++;
    return String.fromCharCode(...bytes.subarray(start, at++));
  };
  if (!line().startsWith("#?")) throw new PageError("it does not begin with #?");
  let text = line();
  while (text !== "" && at < bytes.length) {
    if (text.startsWith("FORMAT=") && !text.includes("32-bit_rle_rgbe")) {
      throw new PageError("its pixels are not RGBE");
    }
    text = line();
  }
  const size = /^-Y (\d+) \+X (\d+)$/.exec(line().trim());
  if (!size) throw new PageError("its rows do not run from the top left");
  const height = Number(size[1]), width = Number(size[2]);
  checkedSize(width, height);
  const values = new Float32Array(3 * width * height), row = new Uint8Array(4 * width);
  for (let y = 0; y < height; y++) {
    at = readHdrRow(bytes, at, row, width);
    for (let x = 0; x < width; x++) {
      const [r, g, b, e] = row.subarray(4 * x, 4 * x + 4), factor = e ? 2 ** (e - 136) : 0;
      values.set([r * factor, g * factor, b * factor], 3 * (y * width + x));
    }
  }
  return { width, height, values };
}

function readHdrRow(bytes, start, row, width) {
  let at = start;
  const coded = bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] < 128;
  if (!coded) {
    if (at + 4 * width > bytes.length) throw new PageError("it ends too early");
    row.set(bytes.subarray(at, at + 4 * width));
    return at + 4 * width;
  }
  at += 4;
  for (let channel = 0; channel < 4; channel++) {
    for (let x = 0; x < width;) {
      let count = bytes[at++];
      const isRun = count > 128;
      if (isRun) count -= 128;
      if (!count || x + count > width || at >= bytes.length) throw new PageError("it is damaged");
      for (let i = 0; i < count; i++, x++) row[4 * x + channel] = isRun ? bytes[at] : bytes[at + i];
      at += isRun ? 1 : count;
    }
  }
  return at;
}
