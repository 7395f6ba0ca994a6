// Draws the object: passes of a few lamps each, which add up in a target of floats.

const MOST_LAMPS = 4;  // lamps of one pass, with a shadow map each
const SHOWS = ["picture", "normals", "tangents", "weights", "coverage", "moved"];
// Where the rays of a pixel go: a grid of 4 x 4 cells as in render.camera_rays, in an order in
// which the first few are spread already.
const RAYS_ORDER = [0, 10, 2, 8, 5, 15, 7, 13, 1, 11, 3, 9, 4, 14, 6, 12];
const RAYS = RAYS_ORDER.map((cell) => [(cell % 4 + 0.5) / 4, (Math.floor(cell / 4) + 0.5) / 4]);

class Painter {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
    if (!gl) {
      throw new PageError("This page needs WebGL 2, which this browser does not offer or has " +
        "switched off. Use a current browser with hardware acceleration.");
    }
    this.gl = gl;
    const floats = gl.getExtension("EXT_color_buffer_float");
    const halves = gl.getExtension("EXT_color_buffer_half_float");
    if (!floats && !halves) {
      throw new PageError("This graphics card cannot draw to images of floating-point numbers " +
        "(EXT_color_buffer_float), which this page needs.");
    }
    this.canReadFloats = Boolean(floats);
    const blends = floats && gl.getExtension("EXT_float_blend");
    this.internal = blends ? gl.RGBA32F : gl.RGBA16F;
    this.present = compiledProgram(gl, FULL_SCREEN, PRESENT);
    this.adding = compiledProgram(gl, FULL_SCREEN, ADD_UP);
    this.depthOnly = compiledProgram(gl, VERTEX, DEPTH_ONLY);
    this.depthBehind = compiledProgram(gl, VERTEX, DEPTH_BEHIND);
    this.depthBetween = compiledProgram(gl, FULL_SCREEN, DEPTH_BETWEEN);
    this.nothing = gl.createVertexArray();
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    this.isSoftware = /swiftshader|llvmpipe|software/i.test(renderer);
  }

  setSurface(surface, header, preview) {
    const { gl } = this;
    this.surface = surface;
    this.header = header;
    this.nIndices = surface.faces.length;
    this.mesh = gl.createVertexArray();
    gl.bindVertexArray(this.mesh);
    [[surface.positions, 3], [surface.uv, 2], [surface.moved, 1]].forEach(([values, size], place) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, surface.faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.previewing = compiledProgram(gl, VERTEX, PREVIEW);
    const [height, width] = preview.shape;
    const values = rgbaOf(Float32Array.from(preview, (code) => code / 255));
    this.previewTexture = floatTexture(gl, gl.TEXTURE_2D, [width, height], values,
      { internal: gl.RGBA16F, format: gl.RGBA, linear: true });
  }

  setField(field, shadowSide) {
    const { gl, header } = this;
    this.unit = field.model.unit;
    this.atlas = [...field.texelOfPixel.shape].reverse();
    this.textures = fieldTextures(gl, header, field);
    const source = shadingOf(header, field, this.textures.tilesAcross, MOST_LAMPS);
    this.shading = compiledProgram(gl, VERTEX, source);
    this.shadows = shadowMaps(gl, header.traced ? shadowSide : 1, MOST_LAMPS);
  }

  // Targets of the size of the window: the sum of images, and the one in work.
  resize(width, height) {
    if (this.sum && this.sum.width === width && this.sum.height === height) return;
    deleteTarget(this.gl, this.sum);
    deleteTarget(this.gl, this.work);
    this.sum = drawTarget(this.gl, width, height, this.internal, false);
    this.work = drawTarget(this.gl, width, height, this.internal, true);
  }

  use({ program, places }) {
    this.gl.useProgram(program);
    return places;
  }

  drawMesh() {
    const { gl } = this;
    gl.bindVertexArray(this.mesh);
    gl.drawElements(gl.TRIANGLES, this.nIndices, gl.UNSIGNED_INT, 0);
  }

  drawScreen() {
    this.gl.bindVertexArray(this.nothing);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  // Clear a target and draw the nearest depths of a camera into it.
  beginImage(target, clip) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.depthMask(true);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.colorMask(false, false, false, false);
    gl.uniformMatrix4fv(this.use(this.depthOnly).u_clip, false, clip);
    this.drawMesh();
    gl.colorMask(true, true, true, true);
    gl.depthMask(false);
  }

  // Maps of the depth half way between the surface that the light reaches and the next one, but
  // not far behind the first. A bias in proportion to the slope would leak at outlines; far sides
  // alone would, and halves of thick parts, where the light leaves the object and grazes it again.
  drawShadows(lamps) {
    const { gl, shadows } = this;
    const nearest = { target: gl.TEXTURE_2D, texture: shadows.nearest.texture };
    const behind = { target: gl.TEXTURE_2D, texture: shadows.behind.texture };
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.depthMask(true);
    gl.viewport(0, 0, shadows.side, shadows.side);
    lamps.forEach((lamp, i) => {
      if (!lamp.casts) return;
      this.drawDepths(this.depthOnly, lamp, shadows.nearest.framebuffer, {});
      this.drawDepths(this.depthBehind, lamp, shadows.behind.framebuffer, { u_nearest: nearest });
      gl.bindFramebuffer(gl.FRAMEBUFFER, shadows.framebuffers[i]);
      gl.depthFunc(gl.ALWAYS);
      const places = this.use(this.depthBetween);
      this.bindSamplers(places, { u_nearest: nearest, u_behind: behind });
      gl.uniform2f(places.u_range, lamp.camera.near, lamp.camera.far);
      gl.uniform1i(places.u_is_parallel, lamp.camera.parallel ? 1 : 0);
      this.drawScreen();
    });
    gl.depthMask(false);
    gl.depthFunc(gl.LEQUAL);
  }

  drawDepths(program, lamp, framebuffer, samplers) {
    const { gl } = this, places = this.use(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.depthFunc(gl.LESS);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.bindSamplers(places, samplers);
    gl.uniformMatrix4fv(places.u_clip, false, lamp.clip);
    this.drawMesh();
  }

  // Add the light of at most MOST_LAMPS lamps to an image that was begun, one of so many that
  // add up, each with another ray of every pixel.
  addLamps(target, camera, clip, lamps, { show = 0, nRays = RAYS.length, isFirst = true }) {
    const { gl, header, surface } = this;
    for (const lamp of lamps) {
      lamp.casts = header.traced && !lamp.isAtEye;
      lamp.camera = lampCamera(lamp);
      lamp.clip = clipFromWorld(lamp.camera);
    }
    if (header.traced && show === 0) this.drawShadows(lamps);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    const places = this.use(this.shading);
    this.bindTextures(places);
    gl.uniformMatrix4fv(places.u_clip, false, clip);
    gl.uniform2i(places.u_atlas, ...this.atlas);
    gl.uniform3fv(places.u_eye, camera.eye);
    gl.uniform4f(places.u_parallel, ...times(camera.rows[2], -1), camera.parallel ? 1 : 0);
    const scale = camera.parallel ? 1 : surface.radius;
    const focal = Math.max(...camera.focal) / (camera.parallel ? surface.radius : 1);
    gl.uniform1f(places.u_pixel, scale / focal / header.texel_width);
    gl.uniform1f(places.u_cell, 1 / Math.sqrt(nRays));
    gl.uniform1i(places.u_show, show);
    gl.uniform3fv(places.u_weight_scale, this.textures.weightScale);
    gl.uniform1f(places.u_alpha, isFirst ? 1 : 0);
    this.setLamps(places, lamps);
    this.drawMesh();
    gl.disable(gl.BLEND);
  }

  setLamps(places, lamps) {
    const { gl } = this;
    const spread = (make, size) => {
      const out = new Float32Array(MOST_LAMPS * size);
      lamps.forEach((lamp, i) => out.set(make(lamp), i * size));
      return out;
    };
    gl.uniform1i(places.u_n_lamps, lamps.length);
    gl.uniform4fv(places.u_lamp, spread((lamp) => [...lamp.at, lamp.isPoint ? 1 : 0], 4));
    gl.uniform3fv(places.u_power, spread((lamp) => lamp.power, 3));
    gl.uniformMatrix4fv(places.u_shadow_clip, false, spread((lamp) => lamp.clip, 16));
    gl.uniform1iv(places.u_casts, Int32Array.from(spread((lamp) => [lamp.casts ? 1 : 0], 1)));
  }

  bindTextures(places) {
    const { gl } = this;
    this.bindSamplers(places, {
      ...this.textures.samplers,
      u_shadows: { target: gl.TEXTURE_2D_ARRAY, texture: this.shadows.texture },
    });
  }

  bindSamplers(places, samplers) {
    const { gl } = this;
    Object.entries(samplers).forEach(([name, { target, texture }], number) => {
      gl.activeTexture(gl.TEXTURE0 + number);
      gl.bindTexture(target, texture);
      gl.uniform1i(places[name], number);
    });
  }

  drawPreview(target, camera, clip) {
    const { gl } = this, places = this.use(this.previewing);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.previewTexture);
    gl.uniform1i(places.u_preview, 0);
    gl.uniform3fv(places.u_eye, camera.eye);
    gl.uniformMatrix4fv(places.u_clip, false, clip);
    this.drawMesh();
  }

  // Add the image in work to the sum, or put it in its place.
  finishImage(replace) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sum.framebuffer);
    gl.viewport(0, 0, this.sum.width, this.sum.height);
    gl.disable(gl.DEPTH_TEST);
    if (replace) gl.disable(gl.BLEND);
    else gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    const places = this.use(this.adding);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.work.texture);
    gl.uniform1i(places.u_image, 0);
    this.drawScreen();
    gl.disable(gl.BLEND);
  }

  // Show the mean of the images in the sum; `exposure` 0 shows values as they are.
  show(nImages, exposure, curve, backdrop) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.disable(gl.DEPTH_TEST);
    const places = this.use(this.present);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.sum.texture);
    gl.uniform1i(places.u_image, 0);
    gl.uniform1f(places.u_share, 1 / nImages);
    gl.uniform1f(places.u_exposure, exposure);
    gl.uniform1i(places.u_curve, curve === "soft" ? 1 : 0);
    gl.uniform3fv(places.u_backdrop, backdrop);
    this.drawScreen();
  }

  // Numbers of an image, for tests and for the exposure: (height, width, 4), row 0 at the top,
  // mean over the rays of a pixel, in the unit of the scene.
  numbers(camera, lamps, options = {}) {
    const { gl } = this, { width, height } = camera, rays = options.rays || RAYS;
    const internal = this.canReadFloats ? gl.RGBA32F : gl.RGBA16F;
    const target = drawTarget(gl, width, height, internal, true);
    const read = new Float32Array(4 * width * height), total = new Float64Array(read.length);
    for (const [x, y] of rays) {
      // One pass at a time: sums of floats cannot be drawn everywhere.
      batchesOf(lamps).forEach((batch, i) => {
        const clip = clipFromWorld(camera, 0.5 - x, 0.5 - y);
        this.beginImage(target, clip);
        this.addLamps(target, camera, clip, batch,
          { ...options, nRays: rays.length, isFirst: i === 0 });
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, read);
        for (let k = 0; k < read.length; k++) total[k] += read[k];
      });
    }
    deleteTarget(gl, target);
    const out = new Float32Array(read.length), row = 4 * width;
    const factors = [this.unit, this.unit, this.unit, 1].map((factor) => factor / rays.length);
    for (let k = 0; k < out.length; k++) {
      const source = (height - 1 - Math.floor(k / row)) * row + k % row;
      out[k] = total[source] * factors[k % 4];
    }
    return out;
  }
}

// Lamps in the parts that one pass draws; one part, of none, where there are none.
function batchesOf(lamps) {
  const batches = [];
  for (let i = 0; i < lamps.length; i += MOST_LAMPS) batches.push(lamps.slice(i, i + MOST_LAMPS));
  return batches.length ? batches : [[]];
}
