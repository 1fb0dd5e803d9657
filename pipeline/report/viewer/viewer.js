/**
 * The joint of the report, to be moved by sliders. Stands last of the files of one script of the page, and after the
 * bundle that defines THREE; reads the JSON of the element `viewer-data`, which `figure_viewer.py` writes.
 *
 * The scene is drawn out of sight and copied to the canvas of the page together with case, side, attitude and notice,
 * so that a picture saved from the page carries them.
 */

const DEGREES_PER_SECOND = 30;
const DEGREES_PER_PIXEL = 0.5;
const ZOOM_STEP = 1.2;
const CLEAR = 0.28;
const FAINT = 0.1;
const UNPOSED = 0x9b9b9b;
const FAR = 0xf3efe6; // beyond the colours of contact: no colour that one of them could be taken for
const BACKGROUND = 0xffffff;
const FONT = '"Segoe UI", Roboto, "Helvetica Neue", Arial, "Liberation Sans", sans-serif';

/** Quantised meshes, axes and lights in scan space; `motion` places what moves. */
class Knee {
  constructor(page, context) {
    this.page = page;
    this.renderer = new THREE.WebGLRenderer({ canvas: context.canvas, context, antialias: true });
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(BACKGROUND);
    this.camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 1, 2000);
    const lamp = new THREE.DirectionalLight(0xffffff, 2.3);
    lamp.position.set(-0.5, 0.8, 1.2);
    this.camera.add(lamp);
    this.moving = new THREE.Group();
    this.moving.matrixAutoUpdate = false;
    this.scene.add(this.camera, this.moving, new THREE.AmbientLight(0xffffff, 1.1));
    this.parts = page.parts.map((part) => this._added(part));
    this.axes = page.axes.flatMap((axis) => this._axis(axis));
  }

  _added(part) {
    const shape = geometry(part);
    shape.setAttribute("color", new THREE.BufferAttribute(new Float32Array(shape.attributes.position.array.length), 3));
    const mesh = new THREE.Mesh(shape, new THREE.MeshLambertMaterial({ vertexColors: true }));
    paint(mesh, new THREE.Color(part.color));
    (part.body === "moving" ? this.moving : this.scene).add(mesh);
    return { ...part, mesh };
  }

  /** A rod, seen through bone, with a head where it is a direction. */
  _axis(axis) {
    const [from, to] = [axis.from, axis.to].map((point) => new THREE.Vector3(...point));
    const along = to.clone().sub(from);
    const material = new THREE.MeshBasicMaterial({ color: axis.color, depthTest: false, transparent: true });
    const radius = this.page.half_height_mm / 160;
    const head = axis.arrow ? 9 * radius : 0;
    const rod = new THREE.CylinderGeometry(radius, radius, along.length() - head);
    const shapes = [[rod, (along.length() - head) / 2]];
    if (head) shapes.push([new THREE.CylinderGeometry(0, 3 * radius, head), along.length() - head / 2]);
    return shapes.map(([shape, middle]) => {
      const mesh = new THREE.Mesh(shape, material);
      mesh.position.copy(from).addScaledVector(along.clone().normalize(), middle);
      mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.clone().normalize());
      mesh.renderOrder = 2;
      (axis.body === "moving" ? this.moving : this.scene).add(mesh);
      return mesh;
    });
  }

  /** Place what moves; grey where the attitude has no pose of its own, else of its own colours or those of contact. */
  place(motion, posed, contact) {
    this.moving.matrix.set(...motion);
    this.moving.matrixWorldNeedsUpdate = true;
    const look = !posed ? "grey" : contact ? "contact" : "own";
    if (look === this.look && look !== "contact") return;
    this.look = look;
    for (const { mesh, color } of this.parts.filter((part) => part.body === "moving")) {
      paint(mesh, new THREE.Color(!posed ? UNPOSED : contact ? FAR : color));
      if (look === "contact") this._paintContact(mesh, motion);
    }
  }

  /** Colours of the distance to the body that stands still, on what is within range of it. */
  _paintContact(mesh, m) {
    const { position, color } = mesh.geometry.attributes;
    const { range_mm: range, colors } = this.page.contact;
    this.scale ??= colors.map((one) => new THREE.Color(one));
    this.nearness ??= new Nearness(this._still(), range);
    for (let n = 0; n < position.count; n++) {
      const [x, y, z] = [position.getX(n), position.getY(n), position.getZ(n)];
      const [a, b, c] = [0, 4, 8].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z + m[row + 3]);
      const distance = this.nearness.distance(a, b, c);
      if (distance > range) continue;
      const shade = this.scale[Math.round((distance / range) * (this.scale.length - 1))];
      color.setXYZ(n, shade.r, shade.g, shade.b);
    }
  }

  _still() {
    const shapes = this.parts.filter((part) => part.body === "reference").map((part) => part.mesh.geometry);
    return shapes.map((shape) => ({ points: shape.attributes.position.array, corners: shape.index.array }));
  }

  /** Bones may be seen through; with colours of contact all of the body is that covers them. */
  show({ axes, clear, contact }) {
    for (const mesh of this.axes) mesh.visible = axes;
    for (const { mesh, bone, body } of this.parts) {
      const covers = contact && body === "reference";
      const through = covers || (clear && bone);
      const { material } = mesh;
      if (material.transparent !== through) material.needsUpdate = true;
      material.transparent = through;
      material.depthWrite = !through;
      material.opacity = covers ? FAINT : through ? CLEAR : 1;
      mesh.renderOrder = through ? 1 : 0;
    }
  }

  draw(eye, width, height) {
    const half = this.page.half_height_mm / eye.zoom;
    const { camera } = this;
    [camera.top, camera.bottom] = [half, -half];
    [camera.right, camera.left] = [(half * width) / height, (-half * width) / height];
    camera.updateProjectionMatrix();
    camera.up.copy(eye.up);
    camera.position.set(...this.page.focus).addScaledVector(eye.toward, 1000);
    camera.lookAt(...this.page.focus);
    this.renderer.setSize(width, height, false);
    this.renderer.render(this.scene, camera);
  }

  /** Where the words of an axis begin on a picture of so many pixels: at its tail, or its end to the right. */
  pixel(axis, width, height) {
    const ends = (axis.arrow ? [axis.from] : [axis.from, axis.to]).map((end) => {
      const point = new THREE.Vector3(...end);
      if (axis.body === "moving") point.applyMatrix4(this.moving.matrix);
      point.project(this.camera);
      return [((point.x + 1) * width) / 2, ((1 - point.y) * height) / 2];
    });
    return ends.reduce((one, other) => (other[0] > one[0] ? other : one));
  }
}

/** Parallel view on the frame of the bone that stands still: azimuth 0 is anterior, 90 lateral. */
class Eye {
  constructor(frame) {
    this.frame = [0, 1, 2].map((column) => new THREE.Vector3(...frame.slice(0, 3).map((row) => row[column])));
    this.hand = Math.sign(this.frame[0].clone().cross(this.frame[1]).dot(this.frame[2]));
    this.zoom = 1;
    this.turnTo(90, 0); // flexion is seen from the side
  }

  turnTo(azimuth, elevation) {
    [this.azimuth, this.elevation] = [azimuth, Math.min(Math.max(elevation, -90), 90)];
    const [a, e] = [this.azimuth, this.elevation].map((degrees) => (degrees * Math.PI) / 180);
    const [lateral, anterior, proximal] = this.frame;
    const level = anterior.clone().multiplyScalar(Math.cos(a)).addScaledVector(lateral, Math.sin(a));
    this.toward = level.clone().multiplyScalar(Math.cos(e)).addScaledVector(proximal, Math.sin(e));
    this.up = proximal.clone().multiplyScalar(Math.cos(e)).addScaledVector(level, -Math.sin(e));
    this.right = this.up.clone().cross(this.toward);
  }

  /** Turn what is seen by pixels to the right and down. */
  drag(right, down) {
    this.turnTo(this.azimuth + this.hand * DEGREES_PER_PIXEL * right, this.elevation + DEGREES_PER_PIXEL * down);
  }

  /** The anatomical word for a direction of the picture; empty where none lies near it. */
  word(direction) {
    const names = [["lateral", "medial"], ["anterior", "posterior"], ["proximal", "distal"]];
    for (const [axis, [ahead, behind]] of names.map((pair, k) => [this.frame[k], pair])) {
      const share = axis.dot(direction);
      if (Math.abs(share) > 0.9) return share > 0 ? ahead : behind;
    }
    return "";
  }
}

/** Sliders, buttons and the canvas of the page. */
class Viewer {
  constructor(root, page, context) {
    this.root = root;
    this.page = page;
    this.lut = new Lut(page.lut);
    this.knee = new Knee(page, context);
    this.eye = new Eye(page.lut.scan_from_reference);
    this.canvas = this.one("canvas");
    this.flexion = this._slider("flexion", this.lut.flexionDeg, 1);
    this.varus = this._slider("varus", this.lut.varusDeg, 0.1);
    this.playing = 0;
    this._listen();
    this._update();
  }

  one(selector) {
    return this.root.querySelector(selector);
  }

  /** A slider over an axis of the table, in even steps near the wanted one, at the value nearest to 0. */
  _slider(name, axis, wanted) {
    const slider = this.one(`input[name=${name}]`);
    const [first, last] = [axis[0], axis[axis.length - 1]];
    slider.min = first;
    slider.max = last;
    slider.step = (last - first) / Math.max(1, Math.round((last - first) / wanted)) || 1;
    slider.value = clipped(axis, 0);
    slider.disabled = first === last;
    return slider;
  }

  _listen() {
    for (const input of this.root.querySelectorAll("input:not([type=file])")) {
      input.addEventListener("input", () => {
        if (input === this.flexion) this._stop();
        this._update();
      });
    }
    for (const button of this.root.querySelectorAll("button[data-azimuth]")) {
      button.addEventListener("click", () => {
        this.eye.turnTo(Number(button.dataset.azimuth), Number(button.dataset.elevation));
        this.draw();
      });
    }
    for (const button of this.root.querySelectorAll("button[data-zoom]")) {
      button.addEventListener("click", () => this._zoom(Number(button.dataset.zoom)));
    }
    this.one("button.play").addEventListener("click", () => (this.playing ? this._stop() : this._play()));
    this._listenToGhost();
    this._listenToCanvas();
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  _listenToGhost() {
    const file = this.one("input[type=file]");
    file.addEventListener("click", () => { file.value = ""; }); // so that the same file can be chosen again
    file.addEventListener("change", () => file.files.length && this._compare(file.files[0]));
    this.one("button.remove").addEventListener("click", () => {
      file.value = "";
      this._haunt(null);
      file.focus();
    });
  }

  /** Show the joint of another report, or say why not. */
  async _compare(file) {
    let [ghost, problem] = [null, ""];
    try {
      ghost = new Ghost(await reportIn(file), this.page);
    } catch (error) {
      if (!(error instanceof Unfit || error instanceof DOMException)) throw error;
      problem = error instanceof Unfit ? error.message : "The browser cannot read this file.";
    }
    this._haunt(ghost, problem);
  }

  /** Take the ghost that is there away and put another in its place, if any. */
  _haunt(ghost, problem = "") {
    this.ghost?.dispose();
    this.ghost = ghost;
    if (ghost) this.knee.scene.add(ghost.group);
    this.one("input[name=ghost]").checked = true;
    this.one(".haunted").hidden = !ghost;
    this.one(".ghost-problem").textContent = problem;
    this.one(".ghost-who").textContent = ghost ? this._whose(ghost) : "";
    this._update();
  }

  _whose(ghost) {
    const here = `${this.page.heading}, in its own colours.`;
    return `${ghost.words}${ghost.mirrored ? ` to lie over this ${this.page.lut.side} one` : ""}. This one: ${here}`;
  }

  /** Move the ghost by its own table, and say how it differs here. */
  _placeGhost(flexion, varus) {
    const there = this.ghost.place(flexion, varus);
    this.ghost.group.visible = this.one("input[name=ghost]").checked;
    const none = "has no stable pose at this attitude";
    if (!this.ghost.moving.visible) return `The other ${none}, so its lower bone is not shown; it covers ${this.ghost.range}.`;
    if (!this.posed) return `This one ${none}, so there is nothing to compare.`;
    return differenceWords(this.lut.coordinates(flexion, varus, "nan"), there);
  }

  _listenToCanvas() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) this._drag(event.movementX, event.movementY);
    });
    canvas.addEventListener("keydown", (event) => {
      if ("+-".includes(event.key)) this._zoom(event.key === "+" ? 1 : -1);
      const way = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] }[event.key];
      if (!way) return;
      event.preventDefault();
      this._drag(...way);
    });
    // a plain wheel scrolls the page
    const wheel = (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this._zoom(Math.sign(-event.deltaY));
    };
    canvas.addEventListener("wheel", wheel, { passive: false });
  }

  _drag(right, down) {
    this.eye.drag(right, down);
    this.draw();
  }

  _zoom(steps) {
    this.eye.zoom = Math.min(Math.max(this.eye.zoom * ZOOM_STEP ** steps, 0.4), 8);
    this.draw();
  }

  _play() {
    const [first, last] = [Number(this.flexion.min), Number(this.flexion.max)];
    let angle = Number(this.flexion.value);
    let way = angle < last ? 1 : -1;
    let before = performance.now();
    const step = (now) => {
      angle += (way * DEGREES_PER_SECOND * Math.max(0, now - before)) / 1000;
      before = now;
      if (angle >= last) [angle, way] = [last, -1];
      else if (angle <= first) [angle, way] = [first, 1];
      this.flexion.value = angle;
      this._update(angle);
      this.playing = requestAnimationFrame(step);
    };
    this.playing = requestAnimationFrame(step);
    this.one("button.play").textContent = "Stop";
  }

  _stop() {
    cancelAnimationFrame(this.playing);
    this.playing = 0;
    this.one("button.play").textContent = "Play";
  }

  /** Show the attitude of the sliders. */
  _update(flexion = Number(this.flexion.value)) {
    const varus = Number(this.varus.value);
    const status = this.lut.status(flexion, varus);
    this.posed = this.page.usable.includes(status);
    this.attitude = `flexion ${degrees(flexion)}, varus ${degrees(varus)}`;
    this.said = this.posed ? "" : this._why(status, flexion, varus);
    this._label(this.flexion, flexion);
    this._label(this.varus, varus);
    const line = this.one("[role=status]");
    if (line.textContent !== this.said) line.textContent = this.said; // each change of it is read out
    const [axes, clear, contact] = ["axes", "clear", "contact"].map((name) => this.one(`input[name=${name}]`).checked);
    this.one(".scale").hidden = !contact;
    try {
      this.knee.place(this.lut.pose(flexion, varus, "clamp"), this.posed, contact);
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      this.knee.moving.visible = false; // no entry of the table can be shown
    }
    this.knee.show({ axes, clear, contact });
    if (this.ghost) this.one(".ghost-difference").textContent = this._placeGhost(flexion, varus);
    this.draw();
  }

  _label(slider, value) {
    this.one(`output[name=${slider.name}]`).textContent = degrees(value);
    slider.setAttribute("aria-valuetext", degrees(value));
  }

  _why(status, flexion, varus) {
    const words = `No stable pose here: ${this.page.status_words[status]}.`;
    try {
      const used = this.lut.coordinates(flexion, varus, "clamp");
      return `${words} Grey: flexion ${degrees(used.flexion_deg)}, varus ${degrees(used.varus_deg)}, the nearest with one.`;
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      return words;
    }
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * ratio));
    if (!width || !height) return;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    this.knee.draw(this.eye, width, height);
    const pen = canvas.getContext("2d");
    pen.drawImage(this.knee.renderer.domElement, 0, 0);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    this._write(pen, width / ratio, height / ratio);
    pen.setTransform(1, 0, 0, 1, 0, 0);
  }

  /** Case, side, attitude, edges and notice on the picture, so that a saved one says what it is. */
  _write(pen, width, height) {
    const { page, eye } = this;
    pen.textBaseline = "middle";
    this._tag(pen, page.heading, [12, 20], { size: 17, bold: true });
    this._tag(pen, this.attitude, [12, 44], { size: 16 });
    this._tag(pen, page.notice, [width - 12, height - 16], { size: 14, bold: true, align: "right" });
    const narrow = width < 700; // there the marks stand clear of heading and notice
    const edges = [
      [eye.right, [width - 12, height / 2], "right"],
      [eye.right.clone().negate(), [12, height / 2], "left"],
      [eye.up, [width / 2, narrow ? 94 : 16], "center"],
      [eye.up.clone().negate(), [width / 2, height - (narrow ? 68 : 16)], "center"],
    ];
    for (const [direction, at, align] of edges) this._tag(pen, eye.word(direction), at, { align, color: "#5d5d5d" });
    if (this.one("input[name=axes]").checked) {
      for (const axis of page.axes) {
        const [x, y] = this.knee.pixel(axis, width, height);
        this._tag(pen, axis.words, [x + 8, y], { color: axis.color, bold: true });
      }
    }
    if (this.said) this._tag(pen, this.said, [12, 70], { size: 15, bold: true, color: "#b34700" });
    if (this.ghost?.group.visible) {
      const color = `#${GHOST_COLOR.toString(16)}`;
      this._tag(pen, this.ghost.words, [12, height - (width < 900 ? 42 : 16)], { size: 15, bold: true, color });
    }
  }

  _tag(pen, words, [x, y], { size = 14, bold = false, align = "left", color = "#1c1c1c" }) {
    pen.font = `${bold ? "bold " : ""}${size}px ${FONT}`;
    pen.textAlign = align;
    pen.lineWidth = 4;
    pen.lineJoin = "round";
    pen.strokeStyle = "rgba(255, 255, 255, 0.85)";
    pen.strokeText(words, x, y);
    pen.fillStyle = color;
    pen.fillText(words, x, y);
  }
}

function degrees(value) {
  const rounded = Math.round(value * 10) / 10;
  return `${rounded === 0 ? "0.0" : rounded.toFixed(1)}°`;
}

/** A mesh from base64: points as 16-bit steps from a corner of its box, corners as 16- or 32-bit numbers. */
function geometry(part) {
  const steps = new Uint16Array(bytes(part.points));
  const points = Float32Array.from(steps, (step, k) => part.low[k % 3] + step * part.step_mm);
  const corners = part.corner_bits === 16 ? new Uint16Array(bytes(part.corners)) : new Uint32Array(bytes(part.corners));
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(points, 3));
  shape.setIndex(new THREE.BufferAttribute(corners, 1));
  shape.computeVertexNormals();
  return shape;
}

function paint(mesh, { r, g, b }) {
  const { color } = mesh.geometry.attributes;
  for (let n = 0; n < color.count; n++) color.setXYZ(n, r, g, b);
  color.needsUpdate = true;
}

function bytes(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)).buffer;
}

/** Show the viewer in place of the sentence that stands there for browsers that cannot. */
function start(root) {
  const context = document.createElement("canvas").getContext("webgl2", { antialias: true });
  if (!context) return;
  const [on, off] = [root.querySelector(".on"), root.querySelector(".off")];
  const swap = (works) => [on.hidden, off.hidden] = [!works, works];
  context.canvas.addEventListener("webglcontextlost", () => swap(false));
  swap(true);
  try {
    new Viewer(root, JSON.parse(document.getElementById("viewer-data").textContent), context);
  } catch (error) {
    swap(false);
    throw error;
  }
}

start(document.getElementById("viewer"));
