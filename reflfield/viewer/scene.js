// What is shown, as plain values: camera, lights, picture; its link; its cameras and lamps.

const FIELD_OF_VIEW = 30 * Math.PI / 180, REFERENCE_DISTANCE = 3;
const STILL_LIGHTS = 64, MOVING_LIGHTS = 8;  // directional lights that stand for a map
// Irradiance of a map of brightness 1, of all directions, in that of a lamp of strength 1.
const MAP_IRRADIANCE = 4;
const BACKDROPS = { dark: [0.085, 0.09, 0.1], grey: [0.46, 0.46, 0.46], light: [0.93, 0.93, 0.92] };
const DEGREE = Math.PI / 180;

function defaultScene(isFlat) {
  const lamp = (on, azimuth, elevation, colour) =>
    ({ on, azimuth: azimuth * DEGREE, elevation: elevation * DEGREE, distance: REFERENCE_DISTANCE, colour, strength: 0 });
  return {
    camera: { azimuth: 0, elevation: isFlat ? 0 : 15 * DEGREE, distance: 4, target: [0, 0, 0] },
    lamps: [lamp(true, 30, 32, "#ffffff"), lamp(false, -60, 25, "#9cc4ff"), lamp(false, 150, 30, "#ffb070")],
    flash: false,
    map: { name: "none", rotation: 0, strength: 0 },
    exposure: 0, curve: "soft", show: "picture", backdrop: "dark", photo: null,
  };
}

// Distance at which the surface fills the free part of the window.
function fittingDistance(surface, frame, view, width, height) {
  const step = 3 * Math.max(1, Math.floor(surface.positions.length / 3 / 3000));
  const fits = (distance) => {
    const camera = orbitCamera({ ...view, distance }, frame, { width, height, free: [0, 0, width, height] });
    for (let i = 0; i < surface.positions.length; i += step) {
      const offset = minus([...surface.positions.subarray(i, i + 3)], camera.eye);
      const [x, y, z] = camera.rows.map((row) => dot(row, offset));
      if (z < 0.05 || Math.abs(x / z) * camera.focal[0] > 0.42 * width ||
        Math.abs(y / z) * camera.focal[1] > 0.42 * height) return false;
    }
    return true;
  };
  let low = 1.2, high = 60;
  for (let i = 0; i < 24; i++) {
    const middle = Math.sqrt(low * high);
    if (fits(middle)) high = middle;
    else low = middle;
  }
  return high;
}

// Camera of an orbit; the principal point is the middle of the window's free part.
function orbitCamera(view, frame, { width, height, free }) {
  const direction = directionAt(frame, view.azimuth, view.elevation);
  const eye = plus(view.target, times(direction, view.distance));
  const focal = 0.5 * Math.min(free[2], free[3]) / Math.tan(FIELD_OF_VIEW / 2);
  return makeCamera({
    rows: lookingAt(eye, view.target, frame.up), eye, width, height, focal: [focal, focal],
    centre: [free[0] + free[2] / 2, free[1] + free[3] / 2],
  });
}

function linearColour(hex) {
  return [1, 3, 5].map((i) => {
    const code = parseInt(hex.slice(i, i + 2), 16) / 255;
    return code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4;
  });
}

const lampDirection = (frame, lamp) => directionAt(frame, lamp.azimuth, lamp.elevation);

// Lamps of a scene, of the scene's own units: irradiance 1 at the middle of the object.
function sceneLamps(scene, frame, camera, mapLights) {
  const lamps = scene.lamps.filter((lamp) => lamp.on).map((lamp) => ({
    at: times(lampDirection(frame, lamp), lamp.distance), isPoint: true,
    power: times(linearColour(lamp.colour), 2 ** lamp.strength * REFERENCE_DISTANCE ** 2),
  }));
  if (scene.flash) {
    const distance = Math.hypot(...camera.eye);
    lamps.push(camera.parallel
      ? { at: times(camera.rows[2], -1), isPoint: false, isAtEye: true, power: [1, 1, 1] }
      : { at: camera.eye, isPoint: true, isAtEye: true, power: [1, 1, 1].map(() => distance ** 2) });
  }
  const turn = mapToWorld(frame.up, scene.map.rotation);
  const factor = 2 ** scene.map.strength;
  return lamps.concat(mapLights.map((light) => ({
    at: turn(light.at), isPoint: false, power: times(light.power, factor),
  })));
}

// Lamps of a capture's lights, in the frame of a mesh.
function calibratedLamps(lights, surface) {
  return lights.map((light) => (light.kind === "point"
    ? {
      at: times(minus(light.position, surface.centre), 1 / surface.radius), isPoint: true,
      power: times(light.intensity, 1 / surface.radius ** 2),
    }
    : { at: unit(light.direction), isPoint: false, power: light.intensity }));
}

// --- link ----------------------------------------------------------------------------------

const short = (values) => values.map((value) => String(Number(value.toPrecision(5)))).join(",");

function linkOf(scene) {
  const { camera, map } = scene, parts = [
    ["view", short([camera.azimuth, camera.elevation, camera.distance, ...camera.target])],
    ...scene.lamps.map((lamp, i) => [`light${i + 1}`, lamp.on ? short([
      lamp.azimuth, lamp.elevation, lamp.distance, lamp.strength]) + "," + lamp.colour.slice(1) : "off"]),
    ["exposure", short([scene.exposure])],
  ];
  if (scene.flash) parts.push(["flash", "on"]);
  if (map.name in MAPS) parts.push(["map", `${map.name},${short([map.rotation, map.strength])}`]);
  for (const name of ["curve", "show", "backdrop"]) parts.push([name, scene[name]]);
  if (scene.photo !== null) parts.push(["photo", String(scene.photo)]);
  return parts.map(([name, value]) => `${name}=${value}`).join("&");
}

// Scene of a link; what is missing or makes no sense stays as it is in the default.
function sceneOfLink(link, defaults, nPhotographs) {
  const scene = structuredClone(defaults), given = new URLSearchParams(link);
  const numbers = (name, limits) => {
    const values = (given.get(name) || "").split(",").slice(0, limits.length).map(Number);
    const usable = values.length === limits.length && values.every(Number.isFinite);
    return usable ? values.map((value, i) => clamp(value, ...limits[i])) : null;
  };
  const angle = [-1e3, 1e3], tilt = [-1.57, 1.57], place = [-2, 2];
  const view = numbers("view", [angle, tilt, [0.2, 100], place, place, place]);
  if (view) {
    const [azimuth, elevation, distance, ...target] = view;
    scene.camera = { azimuth, elevation, distance, target };
  }
  scene.lamps.forEach((lamp, i) => {
    const value = given.get(`light${i + 1}`);
    if (value === "off") lamp.on = false;
    const found = numbers(`light${i + 1}`, [angle, tilt, [1.2, 10], [-4, 4]]);
    if (!found) return;
    [lamp.azimuth, lamp.elevation, lamp.distance, lamp.strength] = found;
    const colour = value.split(",")[4] || "";
    if (/^[0-9a-f]{6}$/.test(colour)) lamp.colour = `#${colour}`;
    lamp.on = true;
  });
  scene.exposure = (numbers("exposure", [[-4, 4]]) || [scene.exposure])[0];
  scene.flash = given.get("flash") === "on";
  const [name, ...map] = (given.get("map") || "").split(",");
  if (Object.hasOwn(MAPS, name) && map.length === 2 && map.map(Number).every(Number.isFinite)) {
    scene.map = { name, rotation: Number(map[0]), strength: clamp(Number(map[1]), -3, 3) };
  }
  const choices = { curve: ["soft", "plain"], show: SHOWS, backdrop: Object.keys(BACKDROPS) };
  for (const [key, known] of Object.entries(choices)) {
    if (known.includes(given.get(key))) scene[key] = given.get(key);
  }
  const photo = Number(given.get("photo") ?? NaN);
  if (Number.isInteger(photo) && photo >= 0 && photo < nPhotographs) scene.photo = photo;
  return scene;
}
