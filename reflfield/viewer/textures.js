// WebGL objects: programs, textures, targets; and the textures of a field.

function compiledProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    console.error(gl.getProgramInfoLog(program), ...logs);
    throw new PageError("The graphics driver cannot compile the page's shaders. Update the " +
      "driver or the browser, or try another one.");
  }
  const places = {};
  const n = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < n; i++) {
    const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

// Texture of floats; kept as `internal`. Depth 0: two-dimensional.
function floatTexture(gl, target, size, values, { internal, format, linear = false, wrap = false }) {
  const texture = gl.createTexture();
  gl.bindTexture(target, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const filter = linear ? gl.LINEAR : gl.NEAREST;
  gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(target, gl.TEXTURE_WRAP_S, wrap ? gl.REPEAT : gl.CLAMP_TO_EDGE);
  gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  if (target === gl.TEXTURE_3D) gl.texParameteri(target, gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE);
  checkSize(gl, target, size);
  if (size.length === 2) {
    gl.texImage2D(target, 0, internal, ...size, 0, format, gl.FLOAT, values);
  } else {
    gl.texImage3D(target, 0, internal, ...size, 0, format, gl.FLOAT, values);
  }
  return texture;
}

function checkSize(gl, target, size) {
  const limits = {
    [gl.TEXTURE_2D]: gl.MAX_TEXTURE_SIZE, [gl.TEXTURE_2D_ARRAY]: gl.MAX_TEXTURE_SIZE,
    [gl.TEXTURE_3D]: gl.MAX_3D_TEXTURE_SIZE,
  };
  const most = gl.getParameter(limits[target]);
  const layers = target === gl.TEXTURE_2D_ARRAY
    ? gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS) : Infinity;
  const sides = target === gl.TEXTURE_3D ? size : size.slice(0, 2);
  if (Math.max(...sides) > most || size[2] > layers) {
    throw new PageError(`This object needs textures of ${size.join(" x ")} pixels, more than ` +
      "this graphics card or browser offers. Try another machine, or make a smaller field.");
  }
}

// Values of texels (`each` numbers) at the pixels of the atlas, in layers of four numbers.
function pixelLayers(texelOfPixel, each, values, before = null) {
  const [height, width] = texelOfPixel.shape, extra = before ? 1 : 0;
  const layers = Math.max(Math.ceil((each + extra) / 4), 1);
  const out = new Float32Array(width * height * 4 * layers);
  texelOfPixel.forEach((texel, pixel) => {
    if (texel < 0) return;
    for (let i = 0; i < each + extra; i++) {
      const value = i < extra ? before[texel] : values[texel * each + i - extra];
      out[((i >> 2) * width * height + pixel) * 4 + (i & 3)] = value;
    }
  });
  return { size: [width, height, layers], values: out };
}

function rgbaOf(rgb) {
  const out = new Float32Array(rgb.length / 3 * 4);
  for (let i = 0; i < rgb.length; i++) out[Math.floor(i / 3) * 4 + i % 3] = rgb[i];
  return out;
}

// Lobes (33 x 33 x 6 nodes each), one after another along z.
function lobeVolume(lobes, nLobes) {
  const nodes = lobes.length / (3 * nLobes), out = new Float32Array(lobes.length / 3 * 4);
  for (let node = 0; node < nodes; node++) {
    for (let k = 0; k < nLobes; k++) {
      for (let c = 0; c < 3; c++) {
        out[(k * nodes + node) * 4 + c] = lobes[(node * nLobes + k) * 3 + c];
      }
    }
  }
  return out;
}

// Tiles of light nodes on a page for each column of view nodes; see the shader.
function nodeVolume(model, viewSide, lightSide, most) {
  const nTiles = model.nClusters * viewSide * model.nFunctions;
  const across = Math.min(Math.ceil(Math.sqrt(nTiles)), Math.floor(most / lightSide));
  const width = across * lightSide, height = Math.ceil(nTiles / across) * lightSide;
  const out = new Float32Array(width * height * viewSide * 4);
  let source = 0;  // (clusters, functions, view rows, view columns, light rows, columns, 3)
  for (let c = 0; c < model.nClusters; c++) for (let k = 0; k < model.nFunctions; k++) {
    for (let row = 0; row < viewSide; row++) for (let column = 0; column < viewSide; column++) {
      const tile = (c * viewSide + row) * model.nFunctions + k;
      const left = (tile % across) * lightSide, top = Math.floor(tile / across) * lightSide;
      for (let y = 0; y < lightSide; y++) for (let x = 0; x < lightSide; x++) {
        const target = ((column * height + top + y) * width + left + x) * 4;
        for (let i = 0; i < 3; i++) out[target + i] = model.values[source++];
      }
    }
  }
  return { size: [width, height, viewSide], values: out, across };
}

// All textures of a field by the names of the shader's samplers, and constants of the shader.
function fieldTextures(gl, header, field) {
  const pixels = field.texelOfPixel, { model } = field;
  const half = { internal: gl.RGBA16F, format: gl.RGBA };
  const smooth = { ...half, linear: true };
  const made = { samplers: {}, tilesAcross: 1, weightScale: [1, 1, 1] };
  const add = (name, target, size, values, kind) => {
    made.samplers[name] = { target, texture: floatTexture(gl, target, size, values, kind) };
  };
  const frames = pixelLayers(pixels, 4, field.frames);
  add("u_frames", gl.TEXTURE_2D, frames.size.slice(0, 2), frames.values,
    { internal: gl.RGBA32F, format: gl.RGBA });
  if (header.model === "half_vector") {
    const { nLobes } = model;
    const diffuse = pixelLayers(pixels, 3, model.diffuse);
    const weights = pixelLayers(pixels, nLobes, model.weights);
    const both = new Float32Array(2 * diffuse.values.length);
    both.set(diffuse.values);
    both.set(weights.values, diffuse.values.length);
    add("u_texels", gl.TEXTURE_2D_ARRAY, [...diffuse.size.slice(0, 2), 2], both, half);
    add("u_lobes", gl.TEXTURE_3D, [33, 33, 6 * nLobes], lobeVolume(model.lobes, nLobes), smooth);
    add("u_skews", gl.TEXTURE_2D_ARRAY, [6, 6, nLobes], rgbaOf(model.skews), smooth);
    add("u_diffuse", gl.TEXTURE_3D, [6, 6, 4], model.table,
      { internal: gl.R16F, format: gl.RED, linear: true });
    const most = [0, 1, 2].map((k) => largest(model.weights.filter((_, i) => i % nLobes === k)));
    made.weightScale = most.map((value) => (value > 0 ? 1 / value : 0));
  } else {
    const layers = pixelLayers(pixels, model.nFunctions - 1, model.coefficients, model.cluster);
    const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const volume = nodeVolume(model, ...header.sides, most);
    // Numbers of clusters are exact in half floats up to 2048.
    const exact = model.nClusters > 2048 ? { ...half, internal: gl.RGBA32F } : half;
    add("u_texels", gl.TEXTURE_2D_ARRAY, layers.size, layers.values, exact);
    add("u_nodes", gl.TEXTURE_3D, volume.size, volume.values, smooth);
    made.tilesAcross = volume.across;
  }
  if (field.indirect) {
    const { nFunctions, rows, columns, table, coefficients } = field.indirect;
    const layers = pixelLayers(pixels, nFunctions - 1, coefficients);
    add("u_indirect", gl.TEXTURE_2D_ARRAY, layers.size, layers.values, half);
    add("u_sphere", gl.TEXTURE_2D_ARRAY, [columns, rows, nFunctions], rgbaOf(table),
      { ...smooth, wrap: true });
  }
  const known = field.lightCovered || Object.assign(Uint8Array.of(1), { shape: [1, 1] });
  add("u_covered", gl.TEXTURE_2D, [known.shape[1], known.shape[0]], Float32Array.from(known),
    { internal: gl.R16F, format: gl.RED });
  return made;
}

// Something to draw to: colour, and depth if asked for.
function drawTarget(gl, width, height, internal, withDepth) {
  const framebuffer = gl.createFramebuffer(), texture = gl.createTexture();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  }
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  const depth = withDepth ? gl.createRenderbuffer() : null;
  if (depth) {
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  }
  return { framebuffer, texture, depth, width, height };
}

function deleteTarget(gl, target) {
  if (!target) return;
  gl.deleteFramebuffer(target.framebuffer);
  gl.deleteTexture(target.texture);
  if (target.depth) gl.deleteRenderbuffer(target.depth);
}

// Layers of shadow maps, one for each lamp of a pass.
function shadowMaps(gl, side, layers) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, side, side, layers);
  setParameters(gl, gl.TEXTURE_2D_ARRAY, gl.LINEAR);
  const compared = [[gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE],
    [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL]];
  for (const [name, value] of compared) gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, value);
  const framebuffers = Array.from({ length: layers }, (_, layer) => {
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, texture, 0, layer);
    return framebuffer;
  });
  return { texture, framebuffers, side, nearest: depthTarget(gl, side), behind: depthTarget(gl, side) };
}

// Depths to be read pixel by pixel.
function depthTarget(gl, side) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, side, side);
  setParameters(gl, gl.TEXTURE_2D, gl.NEAREST);
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  return { texture, framebuffer };
}

function setParameters(gl, target, filter) {
  const parameters = [
    [gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ];
  for (const [name, value] of parameters) gl.texParameteri(target, name, value);
}
