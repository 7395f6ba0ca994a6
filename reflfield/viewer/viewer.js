// The viewer: scene and painter put together, and when to draw what.
//
// While something moves, one image of one ray a pixel is drawn in each frame, with few lights for
// a map. Once all is still, images with other rays and all lights add up, and then nothing is
// drawn any more.

class Viewer {
  constructor(canvas, header, bookmarks) {
    Object.assign(this, { canvas, header, bookmarks, painter: new Painter(canvas) });
    this.field = null;
    this.mapLights = { still: [], moving: [] };
    this.baseExposure = 1;
    this.onDrawn = () => {};
    this.frameRequested = false;
    this.movingScale = 1;
    this.cost = 0;
    this.free = (width, height) => [0, 0, width, height];
    this.frames = { moving: 0, still: 0 };
  }

  setSurface(arrays) {
    this.surface = decodedSurface(arrays);
    this.frame = orbitFrame(this.header.up, this.surface.facing);
    this.preview = arrays.preview;
    this.painter.setSurface(this.surface, this.header, this.preview);
    this.defaults = defaultScene(this.frame.isFlat);
    this.scene = structuredClone(this.defaults);
  }

  // Place the camera so that the object fills the window.
  fit() {
    const [, , width, height] = this.free(this.canvas.clientWidth, this.canvas.clientHeight);
    this.defaults.camera.distance = fittingDistance(
      this.surface, this.frame, this.defaults.camera, width, height);
  }

  setField(arrays) {
    this.field = decodedField(this.header, arrays);
    this.startField();
    this.baseExposure = this.measuredExposure();
  }

  startField() {
    const small = Math.min(screen.width, screen.height) < 600 || (navigator.deviceMemory || 8) < 4;
    const side = this.painter.isSoftware ? 512 : small ? 1024 : 2048;
    this.painter.setField(this.field, side);
  }

  // After the graphics card was lost: the same objects again.
  restart() {
    this.painter = new Painter(this.canvas);
    this.fence = null;
    this.painter.setSurface(this.surface, this.header, this.preview);
    if (this.field) this.startField();
    this.changed();
  }

  setMap(map) {
    if (!map) this.mapLights = { still: [], moving: [] };
    else {
      const pixels = mapPixels(map);
      const total = luminance([0, 1, 2].map((c) => pixels.reduce((s, p) => s + p.power[c], 0)));
      const lights = (n) => mergedLights(pixels, n).map((light) =>
        ({ ...light, power: times(light.power, MAP_IRRADIANCE / (total || 1)) }));
      this.mapLights = { still: lights(STILL_LIGHTS), moving: lights(MOVING_LIGHTS) };
    }
    this.changed();
  }

  // Exposure that brings the default view under the default light to the usual brightness.
  measuredExposure() {
    const camera = orbitCamera({ ...this.defaults.camera, distance: 4 }, this.frame,
      { width: 64, height: 64, free: [0, 0, 64, 64] });
    const numbers = this.painter.numbers(camera, this.lampsOf(this.defaults, camera, []),
      { rays: [[0.5, 0.5]] });
    const values = [];
    for (let i = 0; i < numbers.length; i += 4) {
      if (numbers[i + 3] > 0) values.push(luminance([...numbers.subarray(i, i + 3)]));
    }
    values.sort((a, b) => a - b);
    const white = values[Math.floor(0.97 * (values.length - 1))];
    return white > 0 ? 0.7 / white : 1;
  }

  photo() {
    return this.scene.photo === null ? null : this.bookmarks[this.scene.photo];
  }

  // Camera of the scene for an image of some size.
  cameraFor(width, height) {
    const ratio = width / (this.canvas.clientWidth || width), photo = this.photo();
    const free = this.free(width / ratio, height / ratio).map((value) => value * ratio);
    const place = { width, height, free };
    if (photo) return fittedCamera(calibratedCamera(photo.camera, this.surface), place);
    return orbitCamera(this.scene.camera, this.frame, place);
  }

  lampsOf(scene, camera, mapLights) {
    if (!this.header.known_light) return [{ at: [0, 0, 1], isPoint: false, power: [1, 1, 1] }];
    return sceneLamps(scene, this.frame, camera, mapLights);
  }

  lampsFor(camera, mapLights) {
    const photo = this.photo();
    // A photograph's exposure counts for radiance: powers near 1 keep half floats in range.
    if (!photo) return this.lampsOf(this.scene, camera, mapLights);
    const lamps = this.header.known_light ? calibratedLamps(photo.lights, this.surface)
      : this.lampsOf(this.scene, camera, []);
    const most = Math.max(...lamps.flatMap((lamp) => lamp.power)) || 1;
    this.powerUnit = most;
    return lamps.map((lamp) => ({ ...lamp, power: times(lamp.power, 1 / most) }));
  }

  changed() {
    this.moved = true;
    this.requestFrame();
  }

  requestFrame() {
    if (this.frameRequested || !this.surface) return;
    this.frameRequested = true;
    requestAnimationFrame((time) => {
      this.frameRequested = false;
      if (!this.painter.gl.isContextLost()) this.drawFrame(time);
    });
  }

  drawFrame(time) {
    if (!this.cardIsReady(time)) {
      this.requestFrame();
      return;
    }
    if (this.animate && this.animate(time)) this.moved = true;
    if (this.moved) {
      this.adapt();
      this.moved = false;
      this.drawMoving();
      this.refining = { ray: 0, batch: 0 };
    } else if (this.refining) {
      const passes = this.cost > 40 ? 1 : 4;
      for (let i = 0; i < passes && this.refining; i++) this.refine();
    } else return;
    this.watchCard(time);
    this.requestFrame();
  }

  // Whether the graphics card has done what it was given: work that waits in its queue would
  // delay what the user does next. `cost` is how long it took, milliseconds.
  cardIsReady(time) {
    const { gl } = this.painter;
    if (!this.fence) return true;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.cost = time - this.given;
    return true;
  }

  watchCard(time) {
    const { gl } = this.painter;
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.given = time;
  }

  // Images of fewer pixels where frames take long, only as long as something moves.
  adapt() {
    if (this.wasMoving && this.cost > 70) this.movingScale = Math.max(this.movingScale * 0.75, 0.3);
    else if (this.wasMoving && this.cost < 24) this.movingScale = Math.min(this.movingScale * 1.05, 1);
    this.wasMoving = true;
  }

  setSize(scale) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(this.canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(this.canvas.clientHeight * ratio), 1);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      Object.assign(this.canvas, { width, height });
    }
    this.painter.resize(
      Math.max(Math.round(width * scale), 1), Math.max(Math.round(height * scale), 1));
    return this.cameraFor(this.painter.sum.width, this.painter.sum.height);
  }

  drawMoving() {
    const { painter } = this, camera = this.setSize(this.movingScale);
    const clip = clipFromWorld(camera);
    painter.beginImage(painter.work, clip);
    if (this.field) {
      const options = { show: SHOWS.indexOf(this.scene.show), nRays: 1 };
      batchesOf(this.lampsFor(camera, this.mapLights.moving)).forEach((batch, i) => {
        if (i === 0 || options.show === 0) {
          painter.addLamps(painter.work, camera, clip, batch, { ...options, isFirst: i === 0 });
        }
      });
    } else {
      painter.drawPreview(painter.work, camera, clip);
    }
    painter.finishImage(true);
    this.nImages = 1;
    this.frames.moving += 1;
    this.present(camera);
  }

  // One pass of the image in work: some lamps, for one ray of every pixel.
  refine() {
    if (!this.field) {
      this.refining = null;
      return;
    }
    const { painter, refining } = this, camera = this.setSize(1);
    this.wasMoving = false;
    const [x, y] = RAYS[refining.ray], clip = clipFromWorld(camera, 0.5 - x, 0.5 - y);
    const show = SHOWS.indexOf(this.scene.show);
    const batches = batchesOf(this.lampsFor(camera, this.mapLights.still));
    if (show !== 0) batches.length = 1;
    if (refining.batch === 0) painter.beginImage(painter.work, clip);
    painter.addLamps(painter.work, camera, clip, batches[refining.batch],
      { show, isFirst: refining.batch === 0 });
    refining.batch += 1;
    if (refining.batch < batches.length) return;
    painter.finishImage(refining.ray === 0);
    refining.batch = 0;
    refining.ray += 1;
    this.nImages = refining.ray;
    this.frames.still += 1;
    if (refining.ray === RAYS.length) this.refining = null;
    this.present(camera);
  }

  present(camera) {
    const photo = this.photo(), plain = this.scene.show !== "picture" || !this.field;
    let exposure = 2 ** this.scene.exposure * this.painter.unit;
    exposure *= photo ? photo.exposure * this.powerUnit : this.baseExposure;
    this.painter.show(this.nImages, plain ? 0 : exposure, photo ? "plain" : this.scene.curve,
      BACKDROPS[this.scene.backdrop]);
    this.onDrawn(camera);
  }

  get isStill() {
    return !this.moved && !this.refining && !this.frameRequested;
  }

  // Picture of the window as it is, as a PNG.
  picture() {
    if (this.nImages) this.present(this.cameraFor(this.painter.sum.width, this.painter.sum.height));
    return new Promise((resolve) => this.canvas.toBlob(resolve, "image/png"));
  }
}
