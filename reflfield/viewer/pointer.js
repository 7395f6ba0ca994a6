// Mouse, touch and pen: turning, moving and zooming the view, dragging lights.

const SPEED = 0.007;  // radians for each pixel of a drag

function turnView(scene, dx, dy) {
  scene.camera.azimuth -= dx * SPEED;
  scene.camera.elevation = clamp(scene.camera.elevation + dy * SPEED, -1.55, 1.55);
}

function zoomView(scene, factor) {
  scene.camera.distance = clamp(scene.camera.distance * factor, 0.3, 60);
}

function moveView(viewer, dx, dy) {
  const { scene } = viewer, camera = viewer.cameraFor(viewer.canvas.clientWidth, viewer.canvas.clientHeight);
  const scale = scene.camera.distance / camera.focal[0];
  const shift = plus(times(camera.rows[0], -dx * scale), times(camera.rows[1], -dy * scale));
  scene.camera.target = plus(scene.camera.target, shift).map((value) => clamp(value, -2, 2));
}

function turnLight(scene, lamp, dx, dy) {
  lamp.azimuth += dx * SPEED;
  lamp.elevation = clamp(lamp.elevation - dy * SPEED, -1.55, 1.55);
}

const firstLamp = (scene) => scene.lamps.find((lamp) => lamp.on) || null;

class PointerControl {
  constructor(viewer, { dragsLight, onView, onLight }) {
    Object.assign(this, { viewer, dragsLight, onView, onLight, pointers: new Map() });
    const { canvas } = viewer;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  down(event) {
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.moves = event.button === 1 || event.button === 2 || event.ctrlKey || event.metaKey;
    this.lights = event.shiftKey || this.dragsLight();
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], [dx, dy] = minus(now, before);
    const { scene } = this.viewer;
    if (this.pointers.size === 2) this.pinch(event.pointerId, before, now);
    else if (this.moves) moveView(this.viewer, dx, dy);
    else if (this.lights && firstLamp(scene) && scene.photo === null) {
      turnLight(scene, firstLamp(scene), dx, dy);
      this.onLight();
    } else turnView(scene, dx, dy);
    this.pointers.set(event.pointerId, now);
    if (!this.lights || this.pointers.size === 2) this.onView();
    this.viewer.changed();
  }

  // Two fingers: their distance zooms, their middle moves.
  pinch(id, before, now) {
    const [other] = [...this.pointers].filter(([key]) => key !== id).map(([, place]) => place);
    const ratio = Math.hypot(...minus(before, other)) / (Math.hypot(...minus(now, other)) || 1);
    zoomView(this.viewer.scene, clamp(ratio, 0.8, 1.25));
    moveView(this.viewer, ...times(minus(now, before), 0.5));
  }

  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    zoomView(this.viewer.scene, Math.exp(clamp(pixels, -240, 240) * 0.0012));
    this.onView();
    this.viewer.changed();
  }
}

// Dots that stand for the directions of the lamps, on a sphere around the object.
class LampHandles {
  constructor(viewer, layer, onLight) {
    Object.assign(this, { viewer, layer, onLight });
    this.buttons = viewer.scene.lamps.map((_, i) => this.make(i));
  }

  make(i) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "lamp-handle";
    button.setAttribute("aria-label", `Light ${i + 1}: drag, or use the arrow keys`);
    button.append(document.createElement("i"), document.createElement("b"));
    button.lastChild.textContent = String(i + 1);
    button.addEventListener("pointerdown", (event) => {
      button.setPointerCapture(event.pointerId);
      this.grabbed = { i, behind: button.classList.contains("behind") };
    });
    button.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      button.addEventListener(name, () => { this.grabbed = null; });
    }
    button.addEventListener("keydown", (event) => this.key(event, i));
    this.layer.append(button);
    return button;
  }

  // Middle and radius of the sphere in pixels of the window.
  sphere(camera) {
    const middle = camera.rows.map((row) => -dot(row, camera.eye));
    const { canvas } = this.viewer;
    // Coarse images have whole pixels: the ratios differ.
    const ratios = [canvas.clientWidth / camera.width, canvas.clientHeight / camera.height];
    const depth = Math.max(middle[2], 0.1);
    const [left, top, width, height] = this.viewer.free(canvas.clientWidth, canvas.clientHeight);
    const place = (axis, from, size) => clamp(
      (camera.centre[axis] + camera.focal[axis] * middle[axis] / depth) * ratios[axis], from, from + size);
    return {
      x: place(0, left, width), y: place(1, top, height),
      // Where the object is larger than the window, the dots stay in it.
      radius: clamp(1.05 * camera.focal[0] / depth * ratios[0], 60, 0.43 * Math.min(width, height)),
    };
  }

  place(camera) {
    const { scene, frame, canvas } = this.viewer, { x, y, radius } = this.sphere(camera);
    this.camera = camera;
    this.buttons.forEach((button, i) => {
      const lamp = scene.lamps[i];
      const shown = this.viewer.header.known_light && scene.photo === null;
      button.hidden = !(shown && lamp.on && scene.show === "picture");
      if (button.hidden) return;
      const [right, down, forward] = camera.rows.map((row) => dot(row, lampDirection(frame, lamp)));
      button.classList.toggle("behind", forward > 0);
      button.style.left = `${clamp(x + radius * right, 24, canvas.clientWidth - 24)}px`;
      button.style.top = `${clamp(y + radius * down, 24, canvas.clientHeight - 24)}px`;
      button.style.color = lamp.colour;
    });
  }

  // A dot follows the pointer on the near half of the sphere; beyond the rim it comes back on
  // the far half.
  drag(event) {
    if (!this.grabbed || !event.buttons) return;
    const { x, y, radius } = this.sphere(this.camera), box = this.layer.getBoundingClientRect();
    let place = [(event.clientX - box.left - x) / radius, (event.clientY - box.top - y) / radius];
    const away = Math.hypot(...place);
    let behind = this.grabbed.behind;
    if (away > 1) {
      place = times(place, Math.max(2 - away, 0) / away);
      behind = !behind;
    }
    const depth = Math.sqrt(Math.max(1 - dot(place, place), 0)) * (behind ? 1 : -1);
    const local = [...place, depth], { rows } = this.camera;
    const direction = [0, 1, 2].map((a) => rows.reduce((sum, row, k) => sum + row[a] * local[k], 0));
    const lamp = this.viewer.scene.lamps[this.grabbed.i];
    [lamp.azimuth, lamp.elevation] = anglesOf(this.viewer.frame, direction);
    this.onLight();
    this.viewer.changed();
  }

  key(event, i) {
    const step = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    if (!step[event.key]) return;
    event.preventDefault();
    event.stopPropagation();
    turnLight(this.viewer.scene, this.viewer.scene.lamps[i], ...step[event.key]);
    this.onLight();
    this.viewer.changed();
  }
}
