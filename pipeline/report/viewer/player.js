/**
 * Replay a finished table: the pose of the moving body at any flexion and varus. An ES module without dependencies.
 *
 *     import { Lut } from "./player.js";
 *     const lut = new Lut(data);
 *     const matrix = lut.pose(45, 0, "clamp");
 *
 * The same poses as `pipeline/playback.py`: cubic in flexion (not-a-knot spline over each unbroken run of usable
 * entries of one varus value), linear in varus, then the formula of docs/lut-format.md. Nothing is extrapolated, and
 * nothing is bridged over an entry that is not usable. Degrees and millimetres; scan space is LPS.
 *
 * `data` is plain JSON, with the names and meanings of `lut.h5`, arrays of F flexions and V varus values:
 *   side                                  "right" or "left"
 *   flexion_deg (F), varus_deg (V)        strictly increasing
 *   lateral_mm, anterior_mm, proximal_mm, internal_rotation_deg (F x V)   null where the entry is not usable
 *   status (F x V)                        0 and 1 are usable, others say why not (STATUS)
 *   scan_from_reference, scan_from_moving (4 x 4, row by row)
 */

/** Names of the values of `status`. */
export const STATUS = ["ok", "smoothed", "slid_off", "rotation_bound", "no_contact", "not_converged"];

const FOUND = ["lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg"];
const POLICIES = ["raise", "clamp", "nan"];
const NOTHING = [NaN, NaN, NaN, NaN];
const LAST_USABLE = 1;

/** A look-up table of stable poses, ready for look-up. */
export class Lut {
  /** @param {object} data as described at the top of this file */
  constructor(data) {
    this.side = data.side;
    this.flexionDeg = increasing(data.flexion_deg, "flexion_deg");
    this.varusDeg = increasing(data.varus_deg, "varus_deg");
    this._status = table(data.status, "status", this);
    const named = FOUND.map((name) => table(data[name], name, this));
    this._entries = this._status.map((row, i) =>
      row.map((status, j) => (status <= LAST_USABLE ? named.map((values) => values[i][j]) : null)),
    );
    this._curves = this.varusDeg.map((_, j) => columnCurves(this.flexionDeg, this._entries.map((row) => row[j])));
    this._scanFromReference = data.scan_from_reference.flat();
    this._movingFromScan = inverse(data.scan_from_moving.flat());
  }

  /**
   * Motion of the moving body from where it was scanned to its stable place.
   *
   * @param {number} flexionDeg
   * @param {number} varusDeg
   * @param {"raise"|"clamp"|"nan"} outside for an attitude that the table does not cover (off the grid, or beside an
   *   entry without a stable pose): throw, take the nearest covered one, or answer NaN
   * @returns {Float64Array} `moved_from_scan`, 4 x 4 ROW BY ROW: element (i, j) is at 4 i + j, the shift at 3, 7, 11;
   *   for column vectors of scan space
   * @throws {RangeError} with "raise", for an attitude that is not covered; with "clamp", for NaN and for a table
   *   without a usable entry; for an unknown policy
   */
  pose(flexionDeg, varusDeg = 0, outside = "raise") {
    const at = this._lookUp(flexionDeg, varusDeg, outside);
    if (at.found.some(Number.isNaN)) return new Float64Array(16).fill(NaN);
    const placed = placement(at.flexion, at.varus, at.found);
    return product(product(this._scanFromReference, placed), this._movingFromScan);
  }

  /**
   * The six coordinates of the stable pose; parameters and errors of `pose`.
   *
   * With "clamp" the flexion and varus returned are those that were used.
   */
  coordinates(flexionDeg, varusDeg = 0, outside = "raise") {
    const { flexion, varus, found } = this._lookUp(flexionDeg, varusDeg, outside);
    const named = FOUND.map((name, k) => [name, found[k]]);
    return { flexion_deg: flexion, varus_deg: varus, ...Object.fromEntries(named) };
  }

  /**
   * What keeps an attitude of the grid from being covered.
   *
   * @returns {number} the largest status of the entries that surround it; NaN outside the grid
   */
  status(flexionDeg, varusDeg = 0) {
    const f = locate(this.flexionDeg, flexionDeg);
    const v = locate(this.varusDeg, varusDeg);
    if (!f || !v) return NaN;
    const rows = f.along ? [f.index, f.index + 1] : [f.index];
    const columns = v.along ? [v.index, v.index + 1] : [v.index];
    return Math.max(...rows.flatMap((i) => columns.map((j) => this._status[i][j])));
  }

  _lookUp(flexion, varus, outside) {
    if (!POLICIES.includes(outside)) {
      throw new RangeError(`outside: expected 'raise', 'clamp' or 'nan', got '${outside}'`);
    }
    const found = this._foundAt(flexion, varus);
    if (outside === "nan" || !found.some(Number.isNaN)) return { flexion, varus, found };
    if (outside === "raise") throw new RangeError(this._uncovered(flexion, varus));
    const used = this._nearestCovered(flexion, varus);
    return { flexion: used[0], varus: used[1], found: this._foundAt(...used) };
  }

  /** x, y, z, rotation; NaN where the table does not cover the attitude. */
  _foundAt(flexion, varus) {
    const f = locate(this.flexionDeg, flexion);
    const v = locate(this.varusDeg, varus);
    if (!f || !v) return NOTHING;
    const near = this._onColumn(f, v.index);
    if (!v.along) return near;
    const far = this._onColumn(f, v.index + 1);
    const weight = v.along / (this.varusDeg[v.index + 1] - this.varusDeg[v.index]);
    return near.map((value, k) => (1 - weight) * value + weight * far[k]);
  }

  /** Exactly the entry where `along` is 0, usable or not above it. */
  _onColumn({ index, along }, column) {
    if (!along) return this._entries[index][column] ?? NOTHING;
    const curves = this._curves[column][index];
    return curves ? curves.map(([a, b, c, d]) => ((a * along + b) * along + c) * along + d) : NOTHING;
  }

  _uncovered(flexion, varus) {
    for (const [name, axis, value] of [["flexion", this.flexionDeg, flexion], ["varus", this.varusDeg, varus]]) {
      const [first, last] = [axis[0], axis[axis.length - 1]];
      if (!(first <= value && value <= last)) {
        return `${name} ${short(value)} deg is outside the table, which covers ${short(first)} to ${short(last)} deg`;
      }
    }
    return `the table has no stable pose at flexion ${short(flexion)} deg, varus ${short(varus)} deg`;
  }

  /** The nearest covered attitude: least sum of squared degrees, first at the ends of the grid. */
  _nearestCovered(flexion, varus) {
    if (Number.isNaN(flexion) || Number.isNaN(varus)) {
      throw new RangeError("an attitude that is not a number has no nearest one");
    }
    const ends = [clipped(this.flexionDeg, flexion), clipped(this.varusDeg, varus)];
    if (!this._foundAt(...ends).some(Number.isNaN)) return ends;
    let nearest = null;
    let least = Infinity;
    for (const [low, high] of this._coveredBoxes()) {
      const at = [flexion, varus].map((value, k) => Math.min(Math.max(value, low[k]), high[k]));
      const far = (at[0] - flexion) ** 2 + (at[1] - varus) ** 2;
      if (far < least) [nearest, least] = [at, far];
    }
    if (!nearest) throw new RangeError("the table has no usable entry");
    return nearest;
  }

  /** Lowest and highest (flexion, varus) of every covered piece: cells, their edges, single entries. */
  *_coveredBoxes() {
    const usable = (i, j) => this._entries[i][j] !== null;
    for (const [up, over] of [[1, 1], [1, 0], [0, 1], [0, 0]]) {
      for (let i = 0; i + up < this.flexionDeg.length; i++) {
        for (let j = 0; j + over < this.varusDeg.length; j++) {
          if (usable(i, j) && usable(i + up, j) && usable(i, j + over) && usable(i + up, j + over)) {
            yield [
              [this.flexionDeg[i], this.varusDeg[j]],
              [this.flexionDeg[i + up], this.varusDeg[j + over]],
            ];
          }
        }
      }
    }
  }
}

function increasing(axis, name) {
  if (!axis.length || axis.some((value, k) => k > 0 && !(value > axis[k - 1]))) {
    throw new RangeError(`${name}: expected increasing degrees, got ${axis.length} that are not`);
  }
  return axis;
}

function table(values, name, { flexionDeg, varusDeg }) {
  if (values.length !== flexionDeg.length || values.some((row) => row.length !== varusDeg.length)) {
    throw new RangeError(`${name}: expected ${flexionDeg.length} rows of ${varusDeg.length} values, those of the grid`);
  }
  return values;
}

/** Index of the grid value at or below, and the way on from it; null outside the grid and for NaN. */
function locate(axis, value) {
  if (!(value >= axis[0] && value <= axis[axis.length - 1])) return null;
  let index = axis.length - 1;
  while (axis[index] > value) index--;
  return { index, along: value - axis[index] };
}

function clipped(axis, value) {
  return Math.min(Math.max(value, axis[0]), axis[axis.length - 1]);
}

/** A number as Python's `%g` writes it. */
function short(value) {
  if (Number.isNaN(value)) return "nan";
  return Number.isFinite(value) ? String(Number(value.toPrecision(6))) : value > 0 ? "inf" : "-inf";
}

/** For each interval of a column: four cubics [a, b, c, d] in t = flexion - start, or null where it is not covered. */
function columnCurves(flexion, entries) {
  const curves = new Array(flexion.length).fill(null);
  let start = 0;
  while (start < entries.length) {
    let stop = start;
    while (stop < entries.length && entries[stop]) stop++;
    if (stop - start > 1) {
      const x = flexion.slice(start, stop);
      const each = FOUND.map((_, k) => cubics(x, entries.slice(start, stop).map((entry) => entry[k])));
      for (let i = start; i < stop - 1; i++) curves[i] = each.map((curve) => curve[i - start]);
    }
    start = stop + 1;
  }
  return curves;
}

/** Not-a-knot cubic through two or more samples: highest power first. Two samples give a line, three a parabola. */
function cubics(x, y) {
  const width = x.slice(1).map((value, i) => value - x[i]);
  const chord = width.map((w, i) => (y[i + 1] - y[i]) / w);
  const slope = x.length === 2 ? [chord[0], chord[0]] : solved(...slopeEquations(width, chord));
  return width.map((w, i) => {
    const bend = (slope[i] + slope[i + 1] - 2 * chord[i]) / w;
    return [bend / w, (chord[i] - slope[i]) / w - bend, slope[i], y[i]];
  });
}

/** The second derivative is continuous everywhere, the third also at the second sample and at the last but one. */
function slopeEquations(width, chord) {
  const n = width.length + 1;
  const matrix = Array.from({ length: n }, () => new Float64Array(n));
  const right = new Float64Array(n);
  for (let i = 1; i < n - 1; i++) {
    matrix[i][i - 1] = width[i];
    matrix[i][i] = 2 * (width[i - 1] + width[i]);
    matrix[i][i + 1] = width[i - 1];
    right[i] = 3 * (width[i] * chord[i - 1] + width[i - 1] * chord[i]);
  }
  [matrix[0][0], matrix[0][1], right[0]] = endEquation(width, chord);
  [matrix[n - 1][n - 1], matrix[n - 1][n - 2], right[n - 1]] = endEquation(
    width.slice().reverse(),
    chord.slice().reverse(),
  );
  return [matrix, right];
}

/** Weights of the end sample's slope and its neighbour's, and the right-hand side. */
function endEquation(width, chord) {
  if (width.length === 2) return [1, 1, 2 * chord[0]];
  const [first, second] = width;
  const both = first + second;
  return [second, both, (((first + 2 * both) * second) / both) * chord[0] + ((first * first) / both) * chord[1]];
}

/** Gaussian elimination with partial pivoting. */
function solved(matrix, right) {
  const n = right.length;
  for (let k = 0; k < n; k++) {
    let pivot = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(matrix[i][k]) > Math.abs(matrix[pivot][k])) pivot = i;
    [matrix[k], matrix[pivot]] = [matrix[pivot], matrix[k]];
    [right[k], right[pivot]] = [right[pivot], right[k]];
    for (let i = k + 1; i < n; i++) {
      const factor = matrix[i][k] / matrix[k][k];
      if (!factor) continue;
      for (let j = k; j < n; j++) matrix[i][j] -= factor * matrix[k][j];
      right[i] -= factor * right[k];
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let j = k + 1; j < n; j++) right[k] -= matrix[k][j] * right[j];
    right[k] /= matrix[k][k];
  }
  return right;
}

/** `Rx(-flexion) Ry(varus) (Rz(rotation) | d)` multiplied out, 4 x 4 row by row. */
function placement(flexionDeg, varusDeg, [x, y, z, rotationDeg]) {
  const [f, v, r] = [flexionDeg, varusDeg, rotationDeg].map((degrees) => (degrees * Math.PI) / 180);
  const [cf, cv, cr, sf, sv, sr] = [Math.cos(f), Math.cos(v), Math.cos(r), Math.sin(f), Math.sin(v), Math.sin(r)];
  const [a, b] = [-sf * sv, -cf * sv];
  return [
    ...[cv * cr, -cv * sr, sv, cv * x + sv * z],
    ...[a * cr + cf * sr, cf * cr - a * sr, sf * cv, a * x + cf * y + sf * cv * z],
    ...[b * cr - sf * sr, -b * sr - sf * cr, cf * cv, b * x - sf * y + cf * cv * z],
    ...[0, 0, 0, 1],
  ];
}

function product(left, right) {
  const out = new Float64Array(16);
  for (let i = 0; i < 4; i++) {
    for (let j = 0; j < 4; j++) {
      for (let k = 0; k < 4; k++) out[4 * i + j] += left[4 * i + k] * right[4 * k + j];
    }
  }
  return out;
}

/** Inverse of an affine 4 x 4: cofactors of the linear part, and the shift taken back. */
function inverse(m) {
  const cofactor = (i, j) => {
    const [r, s] = [(i + 1) % 3, (i + 2) % 3];
    const [c, d] = [(j + 1) % 3, (j + 2) % 3];
    return m[4 * r + c] * m[4 * s + d] - m[4 * r + d] * m[4 * s + c];
  };
  const determinant = [0, 1, 2].reduce((sum, j) => sum + m[j] * cofactor(0, j), 0);
  const rows = [0, 1, 2].map((i) => [0, 1, 2].map((j) => cofactor(j, i) / determinant));
  const shifted = rows.map((row) => [...row, -(row[0] * m[3] + row[1] * m[7] + row[2] * m[11])]);
  return [...shifted.flat(), 0, 0, 0, 1];
}
