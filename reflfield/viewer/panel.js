// The panel: controls follow the scene, and the scene follows the controls.

const element = (id) => document.getElementById(id);

const KEYS = [
  ["Arrows", "turn the object"], ["Shift + arrows", "move the light"], ["+  −", "zoom"],
  ["1  2  3", "lights on and off"], ["F", "flashlight"], ["E", "next surroundings"],
  ["V", "next of picture, normals, …"], ["T", "turntable"], ["S", "save the picture"],
  ["L", "copy a link to this view"], ["G", "full screen"], ["C", "hide or show the controls"],
  ["R", "reset"], ["Shift + drag", "move the light"], ["Right drag", "move the object"],
];

class Panel {
  constructor(viewer, act) {
    Object.assign(this, { viewer, act });
    this.lampRows = viewer.scene.lamps.map((_, i) => this.lampControls(i));
    this.bind();
    for (const [keys, words] of KEYS) {
      for (const [tag, text] of [["dt", keys], ["dd", words]]) {
        element("key-list").append(Object.assign(document.createElement(tag), { textContent: text }));
      }
    }
    this.photographs();
    if (!viewer.header.known_light) {
      for (const id of ["lights", "surroundings"]) element(id).hidden = true;
    }
  }

  // Rows of one lamp: on, colour, distance, strength.
  lampControls(i) {
    const group = document.createElement("div");
    group.className = "lamp";
    const row = () => group.appendChild(Object.assign(document.createElement("div"), { className: "row" }));
    const input = (parent, type, id, name, more = {}) => {
      const label = Object.assign(document.createElement("label"), { textContent: name, htmlFor: id });
      const made = Object.assign(document.createElement("input"), { type, id, ...more });
      if (type === "checkbox") {
        label.className = "switch";
        label.prepend(made);
        parent.append(label);
      } else {
        if (name) parent.append(label);
        parent.append(made);
      }
      return made;
    };
    const first = row();
    const made = {
      on: input(first, "checkbox", `lamp-${i + 1}-on`, ` Light ${i + 1}`),
      colour: input(first, "color", `lamp-${i + 1}-colour`, ""),
      distance: input(row(), "range", `lamp-${i + 1}-distance`, "Distance", { min: 1.2, max: 8, step: 0.05 }),
      strength: input(row(), "range", `lamp-${i + 1}-strength`, "Strength", { min: -4, max: 4, step: 0.1 }),
    };
    made.colour.setAttribute("aria-label", `Colour of light ${i + 1}`);
    made.rows = [...group.children].slice(1);
    element("lamps").append(group);
    for (const name of ["on", "colour", "distance", "strength"]) {
      made[name].addEventListener("input", () => {
        const lamp = this.viewer.scene.lamps[i];
        if (name === "on") lamp.on = made.on.checked;
        else lamp[name] = name === "colour" ? made.colour.value : Number(made[name].value);
        this.done();
      });
    }
    return made;
  }

  bind() {
    const listen = (id, change) => element(id).addEventListener("input", () => {
      change(this.viewer.scene, element(id));
      this.done();
    });
    listen("flash-on", (now, { checked }) => { now.flash = checked; });
    listen("map-rotation", (now, { value }) => { now.map.rotation = Number(value) * DEGREE; });
    listen("map-strength", (now, { value }) => { now.map.strength = Number(value); });
    listen("exposure", (now, { value }) => { now.exposure = Number(value); });
    for (const name of ["curve", "show", "backdrop"]) {
      listen(name, (now, { value }) => { now[name] = value; });
    }
    listen("photo", (now, { value }) => { now.photo = value === "" ? null : Number(value); });
    element("wipe").addEventListener("input", () => this.viewer.changed());
    for (const choice of document.querySelectorAll("input[name=map]")) {
      choice.addEventListener("click", () => this.act.map(choice.value));
    }
    for (const name of ["turntable", "save", "full", "link", "reset"]) {
      element(name).addEventListener("click", () => this.act[name]());
    }
    element("help").addEventListener("click", () => element("keys").showModal());
    element("panel-toggle").addEventListener("click", () => this.act.panel());
    element("panel").addEventListener("submit", (event) => event.preventDefault());
    element("full").hidden = !document.documentElement.requestFullscreen;
  }

  // Photographs come last in the page.
  pictures() {
    this.read = this.read || JSON.parse(element("pictures").textContent);
    return this.read;
  }

  photographs() {
    const { bookmarks } = this.viewer;
    element("photographs").hidden = !bookmarks.length;
    bookmarks.forEach((bookmark, i) => {
      element("photo").append(new Option(bookmark.name, String(i)));
    });
  }

  done() {
    this.act.touched();
    this.show();
    this.viewer.changed();
  }

  // Set all controls to what the scene says.
  show() {
    const { scene, header, field } = this.viewer;
    scene.lamps.forEach((lamp, i) => {
      const row = this.lampRows[i];
      row.on.checked = lamp.on;
      row.colour.value = lamp.colour;
      row.distance.value = lamp.distance;
      row.strength.value = lamp.strength;
      for (const hidden of [row.colour, ...row.rows]) hidden.hidden = !lamp.on;
    });
    element("flash-on").checked = scene.flash;
    for (const choice of document.querySelectorAll("input[name=map]")) {
      choice.checked = choice.value === scene.map.name;
    }
    for (const row of document.querySelectorAll(".map-only")) row.hidden = scene.map.name === "none";
    const turns = Math.round(scene.map.rotation / DEGREE);
    element("map-rotation").value = ((turns + 540) % 360) - 180;
    element("map-strength").value = scene.map.strength;
    element("exposure").value = scene.exposure;
    element("exposure-value").textContent = `${scene.exposure >= 0 ? "+" : "−"}${Math.abs(scene.exposure).toFixed(1)}`;
    for (const name of ["curve", "show", "backdrop"]) element(name).value = scene[name];
    element("photo").value = scene.photo === null ? "" : String(scene.photo);
    for (const row of document.querySelectorAll(".photo-only")) row.hidden = scene.photo === null;
    const coverage = element("show").querySelector("[value=coverage]");
    coverage.disabled = !header.known_light || Boolean(field && !field.lightCovered);
    element("show").querySelector("[value=moved]").disabled = !header.moved;
    this.hint();
  }

  hint() {
    const { scene, bookmarks, header } = this.viewer;
    const words = {
      normals: "Normals of the local frames, in the world: red X, green Y, blue Z.",
      tangents: "Tangents of the local frames, in the world: red X, green Y, blue Z.",
      weights: header.model === "half_vector"
        ? "Weights of the first three lobes as red, green and blue."
        : "First three coefficients as red, green and blue about grey.",
      coverage: "Grey: a light stands between lights of the capture. Orange: beyond them, where the capture says nothing.",
      moved: header.moved && "Blue: the surface lies inside of the hull of the silhouettes, red: outside. Full colour: " +
        `${Number((100 * header.moved.share_of_size).toPrecision(2))} % of the object's size.`,
    };
    let text = words[scene.show] || "";
    if (scene.photo !== null && !text) text = bookmarks[scene.photo].note;
    element("hint").textContent = text;
    element("hint").hidden = !text;
  }

  // The photograph over its part of the picture, in the place of the rendered image.
  placePhotograph() {
    const { viewer } = this, photo = viewer.photo(), layer = element("photograph");
    layer.hidden = !photo;
    if (!photo) return;
    const { clientWidth: width, clientHeight: height } = viewer.canvas;
    const box = fittedBox([photo.camera.width, photo.camera.height], viewer.free(width, height));
    ["left", "top", "width", "height"].forEach((name, i) => { layer.style[name] = `${box[i]}px`; });
    const image = element("photograph-image"), share = Number(element("wipe").value);
    if (image.dataset.number !== String(viewer.scene.photo)) {
      image.src = this.pictures()[viewer.scene.photo];
      image.alt = `Photograph ${photo.name}`;
      image.dataset.number = String(viewer.scene.photo);
    }
    image.style.clipPath = `inset(0 ${100 - share}% 0 0)`;
    element("photograph-edge").style.left = `${share}%`;
  }
}
