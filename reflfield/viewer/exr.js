// OpenEXR: single-part scan lines, uncompressed or ZIP, channels of half, float or uint.

function halfToFloat(code) {
  const sign = code & 0x8000 ? -1 : 1, exponent = (code >> 10) & 31, fraction = code & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

const EXR_LINES = { 0: 1, 2: 1, 3: 16 };  // scan lines of a chunk: none, ZIPS, ZIP
const EXR_BYTES = [4, 2, 4];              // of a pixel: uint, half, float

function exrHeader(bytes, data) {
  const version = data.getUint32(4, true);
  if (version & 0x1a00) throw new PageError("it is tiled, deep or has several parts");
  let at = 8;
  const text = () => {
    const start = at;
    while (at < bytes.length && bytes[at]) at++;
    return String.fromCharCode(...bytes.subarray(start, at++));
  };
  const found = {};
  for (let name = text(); name; name = text()) {
    text();
    const size = data.getUint32(at, true);
    found[name] = at + 4;
    at += 4 + size;
  }
  const channels = [], end = at;
  at = found.channels;
  for (let name = text(); name; name = text()) {
    channels.push({ name, kind: data.getUint32(at, true), sampling: data.getUint32(at + 8, true) });
    at += 16;
  }
  const box = [0, 4, 8, 12].map((offset) => data.getInt32(found.dataWindow + offset, true));
  return { channels, box, compression: bytes[found.compression], end };
}

// Undo what ZIP adds to the bytes: differences, and halves of the block interleaved.
function exrReordered(bytes) {
  for (let i = 1; i < bytes.length; i++) bytes[i] = (bytes[i - 1] + bytes[i] - 128) & 255;
  const out = new Uint8Array(bytes.length), half = (bytes.length + 1) >> 1;
  for (let i = 0; i < bytes.length; i++) out[i] = bytes[(i & 1 ? half : 0) + (i >> 1)];
  return out;
}

async function readExr(bytes) {
  const data = new DataView(bytes.buffer), header = exrHeader(bytes, data);
  const { channels, box, compression } = header, linesAtOnce = EXR_LINES[compression];
  if (!linesAtOnce) throw new PageError("its compression is not ZIP");
  const width = box[2] - box[0] + 1, height = box[3] - box[1] + 1;
  checkedSize(width, height);
  const names = channels.some(({ name }) => name === "R") ? ["R", "G", "B"] : ["Y", "Y", "Y"];
  if (!channels.some(({ name }) => name === names[0])) throw new PageError("it has no R, G, B");
  if (channels.some(({ sampling }) => sampling !== 1)) throw new PageError("it is subsampled");
  const perLine = channels.reduce((total, { kind }) => total + width * EXR_BYTES[kind], 0);
  const values = new Float32Array(3 * width * height);
  for (let chunk = 0; chunk * linesAtOnce < height; chunk++) {
    const offset = Number(data.getBigUint64(header.end + 8 * chunk, true));
    const first = data.getInt32(offset, true) - box[1], size = data.getUint32(offset + 4, true);
    const lines = Math.min(linesAtOnce, height - first);
    let content = bytes.slice(offset + 8, offset + 8 + size);
    // What would not become smaller is stored as it is.
    if (compression && size < perLine * lines) {
      content = exrReordered(await inflated(content, "deflate", perLine * lines));
    }
    if (first < 0 || content.length !== perLine * lines) throw new PageError("it is damaged");
    readExrLines(content, { channels, width, first, lines, perLine, names }, values);
  }
  return { width, height, values };
}

function readExrLines(content, { channels, width, first, lines, perLine, names }, values) {
  const data = new DataView(content.buffer);
  for (let line = 0; line < lines; line++) {
    let at = line * perLine;
    for (const { name, kind } of channels) {
      names.forEach((wanted, c) => {
        if (wanted !== name) return;
        for (let x = 0; x < width; x++) {
          const place = at + x * EXR_BYTES[kind];
          const value = kind === 1 ? halfToFloat(data.getUint16(place, true))
            : kind === 2 ? data.getFloat32(place, true) : data.getUint32(place, true);
          values[3 * ((first + line) * width + x) + c] = Number.isFinite(value) ? value : 0;
        }
      });
      at += width * EXR_BYTES[kind];
    }
  }
}
