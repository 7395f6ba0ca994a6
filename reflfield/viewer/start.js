// Start, actions, keys, link, errors; and `reflfield`, by which tests drive the page.

const reflfield = window.reflfield = { ready: null, error: "" };
const header = JSON.parse(element("header").textContent);
const { bookmarks } = header;
const motionIsWelcome = !matchMedia("(prefers-reduced-motion: reduce)").matches;

let viewer = null, panel = null, handles = null, turning = 0, swaying = 0, touchedOnce = false;
let finish, giveUp;
reflfield.ready = new Promise((resolve, reject) => { finish = resolve; giveUp = reject; });
reflfield.ready.catch(() => {});

function say(text) {
  element("message").textContent = text;
  element("message").hidden = !text;
}

function failed(error) {
  const known = error instanceof PageError;
  if (!known) console.error(error);
  reflfield.error = known ? error.message : `The page cannot show the object (${error}).`;
  say(reflfield.error);
  element("loading").hidden = true;
  giveUp(error);
}

function noteBriefly(text) {
  element("hint").textContent = text;
  element("hint").hidden = false;
  setTimeout(() => panel.show(), 4000);
}

// The free part of the window, beside or above the panel; below the title where both would meet.
let titleHeight = 0;  // its greatest: a line that goes away moves nothing
function freePart(width, height) {
  const box = element("panel").getBoundingClientRect(), isBeside = box.width < width - 60;
  const right = box.width && isBeside ? box.left : width;
  const bottom = box.width && !isBeside ? box.top : height;
  titleHeight = Math.max(titleHeight, document.querySelector("header").getBoundingClientRect().bottom);
  const top = right < 700 ? Math.min(titleHeight, 0.15 * bottom) : 0;
  return [0, top, right, bottom - top];
}

const act = {
  touched() {
    touchedOnce = true;
    swaying = 0;
    element("subtitle").hidden = true;
  },
  async map(name) {
    if (name === "file") {
      element("map-file").click();
      panel.show();
      return;
    }
    act.touched();
    viewer.scene.map.name = name;
    viewer.setMap(MAPS[name] ? MAPS[name]() : null);
    panel.show();
  },
  async file(file) {
    try {
      const map = await readMap(file);
      act.touched();
      viewer.scene.map.name = "file";
      viewer.setMap(map);
      element("map-name").textContent = file.name;
      panel.show();
    } catch (error) {
      say(error instanceof PageError ? error.message : `${file.name} cannot be read (${error}).`);
      setTimeout(() => say(""), 8000);
    }
  },
  turntable() {
    turning = turning ? 0 : performance.now();
    element("turntable").setAttribute("aria-pressed", String(Boolean(turning)));
    act.touched();
    leavePhoto();
    viewer.changed();
  },
  async save() {
    const blob = await viewer.picture(), link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${document.title.split(" · ")[0].replace(/[^\w.-]+/g, "_")}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  },
  full() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch(() => {});
  },
  async link() {
    writeLink();
    try {
      await navigator.clipboard.writeText(location.href);
      noteBriefly("The link to this view is copied.");
    } catch (error) {
      noteBriefly("The address of this page now leads to this view.");
    }
  },
  reset() {
    act.touched();
    turning = 0;
    element("turntable").setAttribute("aria-pressed", "false");
    viewer.scene = structuredClone(viewer.defaults);
    viewer.setMap(null);
    panel.show();
  },
  panel(open = document.body.classList.contains("panel-closed")) {
    document.body.classList.toggle("panel-closed", !open);
    element("panel-toggle").setAttribute("aria-expanded", String(open));
    element("panel-toggle").textContent = open ? "Close" : "Controls";
    if (viewer) viewer.changed();
  },
};

// From the camera of a photograph on, with the orbit's camera near it.
function leavePhoto() {
  const photo = viewer.photo();
  if (!photo) return;
  const camera = calibratedCamera(photo.camera, viewer.surface), { scene, frame } = viewer;
  [scene.camera.azimuth, scene.camera.elevation] = anglesOf(frame, camera.eye);
  scene.camera.target = [0, 0, 0];
  scene.camera.distance = viewer.defaults.camera.distance;
  scene.photo = null;
  panel.show();
}

function animate(time) {
  if (turning) {
    viewer.scene.camera.azimuth += Math.min(time - turning, 100) * 0.00035;
    turning = time;
    return true;
  }
  // At first the light moves to and fro once, to show that it can.
  if (swaying) {
    const share = (time - swaying) / 5000, [lamp] = viewer.scene.lamps, [rest] = viewer.defaults.lamps;
    if (share >= 1) swaying = 0;
    lamp.azimuth = rest.azimuth - (swaying ? 1.1 * Math.sin(Math.PI * share) ** 2 : 0);
    return true;
  }
  return false;
}

function writeLink() {
  try {
    history.replaceState(null, "", `#${linkOf(viewer.scene)}`);
  } catch (error) {
    location.hash = linkOf(viewer.scene);
  }
}

function readLink() {
  viewer.scene = sceneOfLink(location.hash.slice(1), viewer.defaults, bookmarks.length);
  const { name } = viewer.scene.map;
  viewer.setMap(MAPS[name] ? MAPS[name]() : null);
  panel.show();
}

const KEY_ACTIONS = {
  t: () => act.turntable(), s: () => act.save(), g: () => act.full(), l: () => act.link(),
  r: () => act.reset(), c: () => act.panel(), "?": () => element("keys").showModal(),
  f: (scene) => { scene.flash = !scene.flash; },
  e: (scene) => {
    const names = ["none", ...Object.keys(MAPS)];
    act.map(names[(names.indexOf(scene.map.name) + 1) % names.length]);
  },
  v: (scene) => {
    const shows = SHOWS.filter((name) => !element("show").querySelector(`[value=${name}]`).disabled);
    scene.show = shows[(shows.indexOf(scene.show) + 1) % shows.length];
  },
  "+": (scene) => zoomView(scene, 0.9), "-": (scene) => zoomView(scene, 1 / 0.9),
};
for (const i of [0, 1, 2]) {
  KEY_ACTIONS[String(i + 1)] = (scene) => { scene.lamps[i].on = !scene.lamps[i].on; };
}
const ARROWS = { ArrowLeft: [-16, 0], ArrowRight: [16, 0], ArrowUp: [0, -16], ArrowDown: [0, 16] };

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || !viewer || element("keys").open) return;
  if (event.target.closest("input:not([type=checkbox]), select")) return;
  const { scene } = viewer, arrow = ARROWS[event.key];
  const action = KEY_ACTIONS[event.key === "=" ? "+" : event.key.toLowerCase()];
  if (arrow && event.shiftKey && firstLamp(scene)) turnLight(scene, firstLamp(scene), ...arrow);
  else if (arrow) {
    leavePhoto();
    turnView(scene, ...arrow);
  } else if (action) action(scene);
  else return;
  event.preventDefault();
  act.touched();
  panel.show();
  viewer.changed();
}

function listen() {
  const onLight = () => act.touched();
  const onView = () => {
    act.touched();
    leavePhoto();
  };
  const dragsLight = () => document.querySelector("input[name=drag]:checked").value === "light";
  new PointerControl(viewer, { dragsLight, onView, onLight });
  handles = new LampHandles(viewer, element("handles"), onLight);
  panel = new Panel(viewer, act);
  viewer.animate = animate;
  viewer.onDrawn = (camera) => {
    handles.place(camera);
    panel.placePhotograph();
  };
  addEventListener("keydown", onKey);
  addEventListener("resize", () => viewer.changed());
  addEventListener("hashchange", readLink);
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) act.file(event.dataTransfer.files[0]);
  });
  element("map-file").addEventListener("change", ({ target }) => {
    if (target.files.length) act.file(target.files[0]);
    target.value = "";
  });
  const { canvas } = viewer;
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say("The graphics card was taken away from this page. It goes on as soon as the card is back; if it does not, reload the page.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    say("");
    try {
      viewer.restart();
    } catch (error) {
      failed(error);
    }
  });
}

// Called between the parts of the page, as soon as a block has arrived.
let blocks = Promise.resolve();
reflfield.block = (number) => {
  const text = element(`block-${number}`).textContent;
  element(`block-${number}`).remove();
  blocks = blocks.then(async () => {
    if (reflfield.error) return;
    const arrays = await unpackedArrays(text, header.blocks[number]);
    if (number === 0) startWithSurface(arrays);
    else startWithField(arrays);
  }).catch(failed);
};

function startWithSurface(arrays) {
  if (header.format !== "reflfield-object" || header.version !== 1) {
    throw new PageError("The data in this file are of another version than its script. Export it again.");
  }
  if (innerWidth <= 720 || innerHeight <= 420) act.panel(false);
  viewer = new Viewer(element("picture"), header, bookmarks);
  viewer.free = freePart;
  viewer.setSurface(arrays);
  listen();
  panel.show();
  viewer.fit();
  readLink();
  reflfield.firstPicture = performance.now();
}

function startWithField(arrays) {
  viewer.setField(arrays);
  element("loading").hidden = true;
  panel.show();
  if (motionIsWelcome && !touchedOnce && !location.hash && header.known_light) {
    swaying = performance.now();
  }
  viewer.changed();
  finish();
}

addEventListener("error", (event) => { if (!viewer || !viewer.field) failed(event.error || event.message); });

// --- tests ---------------------------------------------------------------------------------

// Radiance over black and coverage that a calibrated camera sees under lights, both as the
// library writes them: (height, width, 4) floats as base64.
reflfield.renderTest = (camera, lights, rays) => {
  const numbers = viewer.painter.numbers(
    calibratedCamera(camera, viewer.surface),
    header.known_light ? calibratedLamps(lights, viewer.surface)
      : viewer.lampsOf(viewer.scene, null, []),
    rays ? { rays } : {});
  let text = "";
  for (const byte of new Uint8Array(numbers.buffer)) text += String.fromCharCode(byte);
  return btoa(text);
};
reflfield.viewer = () => viewer;
reflfield.act = act;
