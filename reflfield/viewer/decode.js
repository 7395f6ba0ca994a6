// From the page's packed blocks to the arrays of the field, and from its codes to numbers, as
// reflfield/field decodes them.

const TYPES = {
  int8: Int8Array, uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array,
  int32: Int32Array, float32: Float32Array, float64: Float64Array,
};

class PageError extends Error {}

function product(numbers) {
  return numbers.reduce((total, n) => total * n, 1);
}

// Bytes of a block: base64, then zlib; zlib's checksum tells whether they are whole.
async function unpackedBytes(base64, expected) {
  let packed;
  try {
    packed = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  } catch (error) {
    throw new PageError("The data in this file are damaged. Export it again.");
  }
  if (typeof DecompressionStream === "undefined") {
    throw new PageError("This browser cannot unpack the data (no DecompressionStream). " +
      "Use a version of Chrome, Edge, Firefox or Safari from 2023 or later.");
  }
  return inflated(packed, "deflate", expected).catch(() => {
    throw new PageError("The data in this file are damaged. Export it again.");
  });
}

async function inflated(packed, format, expected) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream(format));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  if (bytes.length !== expected) throw new Error(`${bytes.length} bytes, not ${expected}`);
  return bytes;
}

async function unpackedArrays(base64, block) {
  const bytes = await unpackedBytes(base64, block.bytes);
  const arrays = {};
  for (const entry of block.arrays) arrays[entry.name] = restoredArray(bytes, entry);
  return arrays;
}

// One array: bytes of one significance put back beside the others, differences summed.
function restoredArray(bytes, entry) {
  const Type = TYPES[entry.dtype], size = Type.BYTES_PER_ELEMENT, n = product(entry.shape);
  let raw = bytes.slice(entry.start, entry.start + n * size);
  if (raw.length !== n * size) {
    throw new PageError("The data in this file are incomplete. Export it again.");
  }
  if (entry.planes) {
    const mixed = new Uint8Array(n * size);
    for (let b = 0; b < size; b++) for (let i = 0; i < n; i++) mixed[i * size + b] = raw[b * n + i];
    raw = mixed;
  }
  const values = new Type(raw.buffer);
  for (const axis of entry.delta) sumAlong(values, entry.shape, axis);
  values.shape = entry.shape;
  return values;
}

// Sums along an axis; typed arrays wrap around, as the differences did.
function sumAlong(values, shape, axis) {
  const stride = product(shape.slice(axis + 1)), length = shape[axis];
  const outer = product(shape.slice(0, axis));
  for (let o = 0; o < outer; o++) {
    for (let i = 1; i < length; i++) {
      const row = (o * length + i) * stride;
      for (let s = 0; s < stride; s++) values[row + s] += values[row + s - stride];
    }
  }
}

// Mesh in a frame of its own: the middle of its box at 0, its farthest vertex at distance 1.
function decodedSurface(arrays) {
  const codes = arrays.positions, box = arrays.position_box, n = codes.length / 3;
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const world = new Float64Array(codes.length);
  for (let i = 0; i < codes.length; i++) {
    const axis = i % 3;
    world[i] = codes[i] * box[3] + box[axis];
    low[axis] = Math.min(low[axis], world[i]);
    high[axis] = Math.max(high[axis], world[i]);
  }
  const centre = low.map((value, axis) => 0.5 * (value + high[axis]));
  let radius = 0;
  for (let i = 0; i < n; i++) {
    radius = Math.max(radius, Math.hypot(...[0, 1, 2].map((a) => world[3 * i + a] - centre[a])));
  }
  radius = radius || 1;
  const positions = Float32Array.from(world, (value, i) => (value - centre[i % 3]) / radius);
  const uv = Float32Array.from(
    arrays.uv, (code, i) => code * arrays.uv_box[2] + arrays.uv_box[i % 2]);
  const faces = Uint32Array.from(arrays.faces);
  // How far it lies outside of the hull, in shares of what full colour stands for.
  const moved = Float32Array.from(arrays.moved || new Int8Array(n), (code) => code / 127);
  return { positions, uv, faces, moved, centre, radius, facing: meanNormal(positions, faces) };
}

// Sum of the faces' area vectors over the sum of their areas: 0 of a closed surface, a unit
// vector of a flat one.
function meanNormal(positions, faces) {
  const sum = [0, 0, 0];
  let area = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => positions.subarray(3 * faces[f + k], 3 * faces[f + k] + 3));
    const normal = cross(minus(b, a), minus(c, a));
    area += Math.hypot(...normal);
    normal.forEach((value, axis) => { sum[axis] += value; });
  }
  return sum.map((value) => value / (area || 1));
}

// Unit quaternions (x, y, z, w) of the texels' frames: rotations of each code after another.
function decodedFrames(turns, step) {
  const n = turns.length / 3, out = new Float32Array(4 * n);
  let [a, b, c, d] = [1, 0, 0, 0];
  for (let t = 0; t < n; t++) {
    const v = [turns[3 * t] * step, turns[3 * t + 1] * step, turns[3 * t + 2] * step];
    const angle = Math.hypot(...v);
    const share = angle > 1e-12 ? Math.sin(0.5 * angle) / angle : 0.5;
    const w = Math.cos(0.5 * angle), x = share * v[0], y = share * v[1], z = share * v[2];
    const next = [
      w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
      w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a,
    ];
    const norm = Math.hypot(...next);
    [a, b, c, d] = next.map((value) => value / norm);
    out.set([b, c, d, a], 4 * t);
  }
  return out;
}

function largest(values) {
  let most = 0;
  for (const value of values) most = Math.max(most, Math.abs(value));
  return most;
}

// Half-vector model. What goes into half floats is scaled to at most 1: `unit` is the sample
// (1/sr) that 1 stands for.
function decodedHalfVector(arrays) {
  const nLobes = arrays.lobe_scale.length, n = arrays.diffuse.length / 3;
  const diffuse = new Float32Array(3 * n);
  for (let t = 0; t < n; t++) {
    const [green, red, blue] = arrays.diffuse.subarray(3 * t, 3 * t + 3);
    [red + green, green, blue + green].forEach((root, channel) => {
      diffuse[3 * t + channel] = Math.max(root * arrays.diffuse_scale[0], 0) ** 3;
    });
  }
  const weights = Float32Array.from(arrays.lobe_weights,
    (code, i) => Math.max(code * arrays.lobe_weight_scale[i % nLobes], 0) ** 3);
  const lobes = Float32Array.from(arrays.lobes,
    (code, i) => Math.max(code * arrays.lobe_scale[Math.floor(i / 3) % nLobes], 0) ** 3);
  const peaks = new Float64Array(nLobes), most = new Float64Array(nLobes);
  lobes.forEach((value, i) => {
    const k = Math.floor(i / 3) % nLobes;
    peaks[k] = Math.max(peaks[k], value);
  });
  weights.forEach((value, i) => { most[i % nLobes] = Math.max(most[i % nLobes], value); });
  const strongest = Math.max(...[...most].map((w, k) => w * peaks[k]), 0);
  const unit = Math.max(largest(diffuse), strongest) || 1;
  return {
    unit, nLobes, table: arrays.diffuse_table,
    diffuse: diffuse.map((value) => value / unit),
    weights: weights.map((value, i) => value * peaks[i % nLobes] / unit),
    lobes: lobes.map((value, i) => value / (peaks[Math.floor(i / 3) % nLobes] || 1)),
    skews: Float32Array.from(arrays.lobe_skews, (code) => code / 127),
    strongest: strongest / unit,
  };
}

// Matrix (rows, columns) applied along one axis of an array.
function along(values, shape, axis, matrix, rows) {
  const columns = shape[axis], stride = product(shape.slice(axis + 1));
  const outer = product(shape.slice(0, axis));
  const out = new Float32Array(outer * rows * stride);
  for (let o = 0; o < outer; o++) {
    for (let r = 0; r < rows; r++) {
      const target = out.subarray((o * rows + r) * stride, (o * rows + r + 1) * stride);
      for (let c = 0; c < columns; c++) {
        const factor = matrix[r * columns + c];
        if (factor === 0) continue;
        const source = (o * columns + c) * stride;
        for (let s = 0; s < stride; s++) target[s] += factor * values[source + s];
      }
    }
  }
  return { values: out, shape: shape.map((length, a) => (a === axis ? rows : length)) };
}

// Clustered model: mean and basis of all clusters at all nodes, from the factors.
function decodedClustered(arrays, power) {
  let table = {
    values: Float32Array.from(arrays.core, (code) => code * arrays.core_scale[0]),
    shape: arrays.core.shape,
  };
  table = along(table.values, table.shape, 3, arrays.colour_factor, 3);
  for (const [axis, name] of [[2, "light"], [1, "view"], [0, "function"]]) {
    const codes = arrays[`${name}_factor`], scale = arrays[`${name}_scale`];
    const matrix = Float32Array.from(codes, (code, i) => code * scale[i % scale.length]);
    table = along(table.values, table.shape, axis, matrix, codes.length / scale.length);
  }
  const gain = arrays.function_gain, [nClusters, nFunctions] = gain.shape;
  const each = table.values.length / gain.length;
  const values = table.values.map((value, i) => value * gain[Math.floor(i / each)]);
  const nCoefficients = nFunctions - 1;
  const coefficients = Float32Array.from(arrays.coefficients, (code, i) => {
    const texel = Math.floor(i / nCoefficients), k = i % nCoefficients;
    return code * arrays.coefficient_scale[arrays.cluster[texel] * nCoefficients + k];
  });
  // Roots of samples, and functions: basis functions are scaled with their coefficients.
  const peaks = new Float64Array(nFunctions);
  values.forEach((value, i) => {
    const k = Math.floor(i / each) % nFunctions;
    peaks[k] = Math.max(peaks[k], Math.abs(value));
  });
  const root = peaks[0] || 1;
  return {
    unit: root ** power, nClusters, nFunctions, cluster: arrays.cluster,
    values: values.map((value, i) => value / (peaks[Math.floor(i / each) % nFunctions] || 1)),
    coefficients: coefficients.map((value, i) => value * peaks[1 + i % nCoefficients] / root),
  };
}

// Indirect light in units of the model: table (functions, rows, columns, 3) and coefficients.
function decodedIndirect(arrays, root) {
  const codes = arrays.indirect_table, scale = arrays.indirect_table_scale;
  const [n, rows, columns] = codes.shape, each = rows * columns, nFunctions = n / 3;
  const table = new Float32Array(nFunctions * each * 3);
  for (let i = 0; i < codes.length; i++) {
    const plane = Math.floor(i / each), k = Math.floor(plane / 3);
    // The mean is in the unit of roots of samples, the others have coefficients in it.
    const value = codes[i] * scale[plane] / (k === 0 ? root : 1);
    table[(k * each + i % each) * 3 + plane % 3] = value;
  }
  const coefficients = Float32Array.from(
    arrays.indirect_coefficients, (code) => code * arrays.indirect_scale[0] / root);
  return { nFunctions, rows, columns, table, coefficients };
}

function decodedField(header, arrays) {
  const model = header.model === "half_vector"
    ? decodedHalfVector(arrays) : decodedClustered(arrays, header.power);
  const field = {
    model, frames: decodedFrames(arrays.turns, arrays.turn_step[0]),
    texelOfPixel: arrays.texel_of_pixel, lightCovered: arrays.light_covered || null,
    indirect: null,
  };
  if (header.indirect) field.indirect = decodedIndirect(arrays, model.unit ** (1 / header.power));
  return field;
}
