/**
 * The joint of another report - the other knee, or an earlier study - as a ghost over the joint of this page. The file
 * is read as text; nothing of it runs, and of its data only what `checkedReport` has looked at is used.
 */

const GHOST_COLOR = 0xc2187a; // no structure, no axis and no colour of contact
const GHOST_OPACITY = 0.42;
const LARGEST_REPORT = 60e6;
/** Before the data of a page; put together, so that it does not stand in the page a second time. */
const MODEL = `<${"script"} type="application/json" id="viewer-data">`;
const MOST_PARTS = 200;
const LONGEST_TEXT = 200;
/** Coordinate, words for more of it and for less, unit. */
const DIFFERENCES = [
  ["lateral_mm", "more lateral", "more medial", " mm"],
  ["anterior_mm", "more anterior", "more posterior", " mm"],
  ["proximal_mm", "more proximal", "more distal", " mm"],
  ["internal_rotation_deg", "more internally rotated", "more externally rotated", "°"],
];

/** Why a file cannot be compared with; its message is a sentence for the reader. */
class Unfit extends Error {}

/** The model of the report in a file. */
async function reportIn(file) {
  if (file.size > LARGEST_REPORT) throw new Unfit("This file is too large to be a report of this program.");
  // looked for as text: nothing of a foreign file becomes an element, and our own JSON holds no "<"
  const [, ...found] = (await file.text()).split(MODEL);
  if (found.length !== 1) throw new Unfit("This file is not a report of this program. Choose the report.html of another case.");
  try {
    return checkedReport(JSON.parse(found[0].split("<", 1)[0]));
  } catch (error) {
    if (!(error instanceof Misfit || error instanceof SyntaxError)) throw error;
    const words = error instanceof Misfit ? error.message : "not JSON";
    throw new Unfit(`The model in this report cannot be used (${words}): the file is damaged, or another version made it.`);
  }
}

/** What is not as it has to be. */
class Misfit extends Error {}

function must(holds, words) {
  if (!holds) throw new Misfit(words);
}

/** The data of another report's viewer, its every shape looked at, and nothing else of it. */
function checkedReport(data) {
  must(data !== null && typeof data === "object", "no model");
  const { heading, joint, lut, parts } = data;
  for (const words of [heading, joint]) must(typeof words === "string" && words.length <= LONGEST_TEXT, "no heading");
  must(lut !== null && typeof lut === "object", "no table");
  must(Array.isArray(parts) && parts.length > 0 && parts.length <= MOST_PARTS, "no surfaces");
  return { heading, joint, lut: checkedTable(lut), parts: parts.map(checkedPart) };
}

function checkedTable(lut) {
  must(["right", "left"].includes(lut.side), "side");
  for (const name of ["flexion_deg", "varus_deg"]) {
    const axis = lut[name];
    must(Array.isArray(axis) && axis.length > 0 && axis.every(Number.isFinite), name);
    must(axis.every((value, k) => k === 0 || value > axis[k - 1]), name);
  }
  const grid = (rows, fits) =>
    Array.isArray(rows) && rows.length === lut.flexion_deg.length && rows.every((row, i) => Array.isArray(row) &&
      row.length === lut.varus_deg.length && row.every((value, j) => fits(value, i, j)));
  must(grid(lut.status, (status) => Number.isInteger(status) && status >= 0 && status < STATUS.length), "status");
  const known = (value, i, j) => Number.isFinite(value) || (value === null && lut.status[i][j] > LAST_USABLE);
  for (const name of FOUND) must(grid(lut[name], known), name);
  for (const name of ["scan_from_reference", "scan_from_moving"]) must(isFrame(lut[name]), name);
  const names = ["side", "flexion_deg", "varus_deg", "status", ...FOUND, "scan_from_reference", "scan_from_moving"];
  return Object.fromEntries(names.map((name) => [name, lut[name]]));
}

/** Whether 4 x 4 rows are unit axes at right angles, of either hand, and a shift. */
function isFrame(rows) {
  const whole = Array.isArray(rows) && rows.length === 4;
  if (!whole || !rows.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite))) return false;
  const dot = (a, b) => rows[0][a] * rows[0][b] + rows[1][a] * rows[1][b] + rows[2][a] * rows[2][b];
  const right = [[0, 1], [0, 2], [1, 2]].every(([a, b]) => Math.abs(dot(a, b)) < 1e-6);
  return right && [0, 1, 2].every((a) => Math.abs(dot(a, a) - 1) < 1e-6) && rows[3].join() === "0,0,0,1";
}

function checkedPart(part) {
  must(part !== null && typeof part === "object", "surface");
  const { body, low, step_mm, points, corner_bits, corners } = part;
  must(["reference", "moving"].includes(body), "surface without a body");
  must(Array.isArray(low) && low.length === 3 && low.every(Number.isFinite), "surface without a place");
  must(Number.isFinite(step_mm) && step_mm > 0 && [16, 32].includes(corner_bits), "surface without a scale");
  const [places, triangles] = [points, corners].map(byteCount);
  must(places > 0 && places % 6 === 0 && triangles > 0 && triangles % (3 * (corner_bits / 8)) === 0, "surface of no triangles");
  const numbers = corner_bits === 16 ? new Uint16Array(bytes(corners)) : new Uint32Array(bytes(corners));
  must(numbers.every((corner) => corner < places / 6), "surface with a corner that is nowhere");
  return { body, low, step_mm, points, corner_bits, corners };
}

/** Bytes of a text of base64; 0 where it is none. */
function byteCount(text) {
  if (typeof text !== "string" || text.length % 4 || !/^[A-Za-z0-9+/]*={0,2}$/.test(text)) return 0;
  return (text.length / 4) * 3 - (text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0);
}

/** Another report's joint, in the space of this page's scan: the frames of the bones that stand still coincide. */
class Ghost {
  /**
   * @param {object} other of `reportIn`
   * @param {object} page data of this page's own viewer
   */
  constructor(other, page) {
    if (other.joint !== page.joint) throw new Unfit(`That report is of another joint: ${other.joint}. This one: ${page.joint}.`);
    this.heading = other.heading;
    this.mirrored = other.lut.side !== page.lut.side;
    this.lut = new Lut(other.lut);
    this.group = placedGroup();
    this.moving = placedGroup();
    this.group.add(this.moving);
    // frames are right-handed for a right joint and left-handed for a left one: between two sides this is a mirror
    const [here, there] = [page, other].map(({ lut }) => lut.scan_from_reference.flat());
    this.group.matrix.set(...product(here, inverse(there)));
    for (const part of other.parts) this._add(part);
  }

  /** One skin of glass: the depth of the whole ghost first, then its colour where it is in front. */
  _add(part) {
    const shape = geometry(part);
    const behind = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 8 }; // equal surfaces do not flicker
    const look = { color: GHOST_COLOR, transparent: true, opacity: GHOST_OPACITY };
    const materials = [
      new THREE.MeshLambertMaterial({ colorWrite: false, transparent: true, ...behind }),
      new THREE.MeshLambertMaterial({ ...look, depthWrite: false, ...behind }),
    ];
    materials.forEach((material, k) => {
      const mesh = new THREE.Mesh(shape, material);
      mesh.renderOrder = 1.4 + k / 10; // after what is solid or glass, before the axes
      (part.body === "moving" ? this.moving : this.group).add(mesh);
    });
  }

  /** Its own pose at an attitude, or none; returns its coordinates there, NaN where its table has no pose. */
  place(flexion, varus) {
    const motion = this.lut.pose(flexion, varus, "nan");
    this.moving.visible = !Number.isNaN(motion[0]);
    if (this.moving.visible) this.moving.matrix.set(...motion);
    this.moving.matrixWorldNeedsUpdate = true;
    return this.lut.coordinates(flexion, varus, "nan");
  }

  dispose() {
    this.group.removeFromParent();
    this.group.traverse((one) => {
      one.geometry?.dispose();
      one.material?.dispose();
    });
  }

  /** Whose it is. */
  get words() {
    return `Ghost: ${this.heading}${this.mirrored ? ", mirrored" : ""}`;
  }

  /** What its table covers. */
  get range() {
    const ends = [this.lut.flexionDeg, this.lut.varusDeg].map((axis) => [axis[0], axis[axis.length - 1]].map(degrees));
    return `flexion ${ends[0].join(" to ")} and varus ${ends[1].join(" to ")}`;
  }
}

function placedGroup() {
  const group = new THREE.Group();
  group.matrixAutoUpdate = false;
  return group;
}

/** How the lower bone of the other stands against this one's, both with the coordinates of one attitude. */
function differenceWords(one, other) {
  const words = DIFFERENCES.flatMap(([name, more, less, unit]) => {
    const difference = other[name] - one[name];
    const size = Math.abs(difference).toFixed(1);
    return size === "0.0" ? [] : [`${size}${unit} ${difference > 0 ? more : less}`];
  });
  if (!words.length) return "The lower bone of the other stands as this one does, to 0.1 mm and 0.1°.";
  return `The lower bone of the other is ${words.join(", ")}${words.length < DIFFERENCES.length ? "; otherwise the same" : ""}.`;
}
