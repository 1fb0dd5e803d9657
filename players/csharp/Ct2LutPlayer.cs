// Replay a finished ct2lut table in C#: the pose of the moving bone at any flexion and varus.
//
// One file, no dependency: .NET Standard 2.1, C# 7.2, as Unity has them since 2021. Research use - not for diagnosis.
//
//     var player = Ct2Lut.Player.FromJson(text);                          // once; the text of lut.json
//     double[] moved = player.Pose(45.0, 0.0, Ct2Lut.Outside.Clamp);      // each frame; 4x4 row by row, LPS mm
//
// The same poses as pipeline/playback.py and pipeline/report/viewer/player.js: cubic in flexion (not-a-knot spline over
// each unbroken run of usable entries of one varus value), linear in varus, then the formula of docs/lut-format.md.
// Nothing is extrapolated, and nothing is bridged over an entry that is not usable. Degrees and millimetres.
//
// In Unity, which is left-handed with metres and y up (see UnitySpace), under one common parent:
//
//     // once: both meshes from scan space; the corners of every triangle in the order a, c, b
//     vertices[i] = (x, y, z) of UnitySpace.Point(x, y, z) of the scan's vertex
//     // each frame, on the moving bone; the reference bone stays
//     UnityPlacement at = UnitySpace.Placement(moved);
//     tibia.localPosition = new Vector3((float)at.X, (float)at.Y, (float)at.Z);
//     tibia.localRotation = new Quaternion((float)at.QX, (float)at.QY, (float)at.QZ, (float)at.QW);

using System;
using System.Collections.Generic;
using System.Globalization;
using System.Text;

namespace Ct2Lut
{
    /// <summary>What to do with an attitude that the table does not cover: off the grid, or beside an entry without a
    /// stable pose.</summary>
    public enum Outside
    {
        /// <summary>Throw NotCoveredException.</summary>
        Raise,
        /// <summary>Take the nearest covered attitude (least sum of squared degrees), first at the ends of the grid.
        /// Throws NotCoveredException for NaN and for a table without a usable entry.</summary>
        Clamp,
        /// <summary>Answer NaN.</summary>
        NaN,
    }

    /// <summary>The table has no pose at an attitude.</summary>
    public sealed class NotCoveredException : Exception
    {
        public NotCoveredException(string message) : base(message) { }
    }

    /// <summary>The six coordinates of a pose: flexion, varus, internal rotation +; lateral, anterior, proximal
    /// translation of the moving bone +. The same signs for a right and for a left joint.</summary>
    public struct Coordinates
    {
        public double FlexionDeg, VarusDeg, InternalRotationDeg, LateralMm, AnteriorMm, ProximalMm;
    }

    /// <summary>A table as plain arrays: F flexions, V varus values, entry (i, j) of a curve at i * V + j.</summary>
    public sealed class TableData
    {
        /// <summary>"right" or "left".</summary>
        public string Side = "";
        /// <summary>The grid, strictly increasing degrees; (F) and (V).</summary>
        public double[] FlexionDeg, VarusDeg;
        /// <summary>Found coordinates, (F * V); not read where the entry is not usable.</summary>
        public double[] LateralMm, AnteriorMm, ProximalMm, InternalRotationDeg;
        /// <summary>(F * V): 0 ok and 1 smoothed are usable, others are not.</summary>
        public int[] Status;
        /// <summary>Kinematic frames in scan space (LPS mm), 4x4 row by row; left-handed for a left joint.</summary>
        public double[] ScanFromReference, ScanFromMoving;

        /// <summary>Reads lut.json, or the JSON of the players, which has the same members without the sections axes,
        /// coordinates and frames: tables as F rows of V values with null where an entry is not usable, frames as 4 rows
        /// of 4. Other members are ignored. Throws FormatException.</summary>
        public static TableData FromJson(string text)
        {
            var all = Json.Parse(text) as Dictionary<string, object>;
            if (all == null) throw new FormatException("expected a JSON object");
            double[] status = Json.Numbers(all, "status");
            Dictionary<string, object> axes = Json.Section(all, "axes"), frames = Json.Section(all, "frames");
            Dictionary<string, object> coordinates = Json.Section(all, "coordinates");
            return new TableData
            {
                Side = Json.Member(all, "side") as string ?? "",
                FlexionDeg = Json.Numbers(axes, "flexion_deg"),
                VarusDeg = Json.Numbers(axes, "varus_deg"),
                LateralMm = Json.Numbers(coordinates, "lateral_mm"),
                AnteriorMm = Json.Numbers(coordinates, "anterior_mm"),
                ProximalMm = Json.Numbers(coordinates, "proximal_mm"),
                InternalRotationDeg = Json.Numbers(coordinates, "internal_rotation_deg"),
                Status = Array.ConvertAll(status, value => double.IsNaN(value) ? -1 : (int)value),
                ScanFromReference = Json.Numbers(frames, "scan_from_reference"),
                ScanFromMoving = Json.Numbers(frames, "scan_from_moving"),
            };
        }
    }

    /// <summary>A look-up table of stable poses, ready for look-up. An unknown value of Outside is an ArgumentException.
    /// Immutable: any number of threads may ask.</summary>
    public sealed class Player
    {
        const int LastUsable = 1;
        const double DegreesToRadians = Math.PI / 180.0;

        readonly double[] _flexion, _varus;
        readonly Found[] _entries;
        /// Cubics of the interval above an entry; null where that is not covered.
        readonly Cubics[] _curves;
        readonly double[] _scanFromReference, _movingFromScan;

        /// <summary>Makes a table ready. Throws ArgumentException for arrays that do not fit one another.</summary>
        public Player(TableData table)
        {
            Side = table.Side;
            _flexion = Increasing(table.FlexionDeg, "flexion");
            _varus = Increasing(table.VarusDeg, "varus");
            _entries = Entries(table);
            _curves = new Cubics[_entries.Length];
            for (int column = 0; column < _varus.Length; column++) FillColumn(column);
            _scanFromReference = Frame(table.ScanFromReference);
            _movingFromScan = RigidInverse(Frame(table.ScanFromMoving));
        }

        /// <summary>The table of the players' JSON; see TableData.FromJson.</summary>
        public static Player FromJson(string text) { return new Player(TableData.FromJson(text)); }

        /// <summary>"right" or "left".</summary>
        public string Side { get; }

        /// <summary>First and last flexion of the grid, degrees.</summary>
        public double FirstFlexion { get { return _flexion[0]; } }
        public double LastFlexion { get { return _flexion[_flexion.Length - 1]; } }

        /// <summary>First and last varus of the grid, degrees.</summary>
        public double FirstVarus { get { return _varus[0]; } }
        public double LastVarus { get { return _varus[_varus.Length - 1]; } }

        /// <summary>Motion of the moving bone from where it was scanned to its stable place: moved_from_scan, 16 numbers
        /// row by row (element (i, j) at 4 i + j, the shift at 3, 7, 11), for column vectors of scan space (LPS mm).
        /// All NaN where not covered, with Outside.NaN.</summary>
        public double[] Pose(double flexionDeg, double varusDeg = 0.0, Outside outside = Outside.Raise)
        {
            var motion = new double[16];
            Pose(flexionDeg, varusDeg, outside, motion);
            return motion;
        }

        /// <summary>The same into an array of the caller's: nothing is allocated for a covered attitude.</summary>
        public void Pose(double flexionDeg, double varusDeg, Outside outside, double[] motion)
        {
            Found found = LookUp(ref flexionDeg, ref varusDeg, outside);
            if (!found.Known)
            {
                for (int k = 0; k < 16; k++) motion[k] = double.NaN;
                return;
            }
            Place(flexionDeg * DegreesToRadians, varusDeg * DegreesToRadians, found, motion);
        }

        /// <summary>The six coordinates; with Outside.Clamp flexion and varus are those that were used.</summary>
        public Coordinates Coordinates(double flexionDeg, double varusDeg = 0.0, Outside outside = Outside.Raise)
        {
            Found found = LookUp(ref flexionDeg, ref varusDeg, outside);
            return new Coordinates
            {
                FlexionDeg = flexionDeg, VarusDeg = varusDeg, InternalRotationDeg = found.Turn,
                LateralMm = found.X, AnteriorMm = found.Y, ProximalMm = found.Z,
            };
        }

        /// The found coordinates of one attitude (mm, degrees).
        struct Found
        {
            public bool Known;
            public double X, Y, Z, Turn;
            public static readonly Found Nothing =
                new Found { X = double.NaN, Y = double.NaN, Z = double.NaN, Turn = double.NaN };
        }

        /// Four cubics, each c0 t^3 + c1 t^2 + c2 t + c3.
        sealed class Cubics
        {
            public readonly double[] X = new double[4], Y = new double[4], Z = new double[4], Turn = new double[4];

            public Found At(double t)
            {
                return new Found { Known = true, X = One(X, t), Y = One(Y, t), Z = One(Z, t), Turn = One(Turn, t) };
            }

            static double One(double[] c, double t) { return ((c[0] * t + c[1]) * t + c[2]) * t + c[3]; }
        }

        static double[] Increasing(double[] axis, string name)
        {
            bool increases = axis != null && axis.Length > 0;
            for (int k = 1; increases && k < axis.Length; k++) increases = axis[k] > axis[k - 1];
            if (!increases) throw new ArgumentException(name + ": expected strictly increasing degrees");
            return (double[])axis.Clone();
        }

        static double[] Frame(double[] frame)
        {
            if (frame == null || frame.Length != 16) throw new ArgumentException("a frame: expected 16 numbers");
            return (double[])frame.Clone();
        }

        Found[] Entries(TableData table)
        {
            int count = _flexion.Length * _varus.Length;
            foreach (Array one in new Array[] { table.LateralMm, table.AnteriorMm, table.ProximalMm,
                                                table.InternalRotationDeg, table.Status })
            {
                if (one == null || one.Length != count)
                    throw new ArgumentException("a table: expected " + count + " entries, those of the grid");
            }
            var entries = new Found[count];
            for (int k = 0; k < count; k++)
            {
                bool usable = table.Status[k] >= 0 && table.Status[k] <= LastUsable;
                entries[k] = !usable ? Found.Nothing : new Found
                {
                    Known = true, X = table.LateralMm[k], Y = table.AnteriorMm[k], Z = table.ProximalMm[k],
                    Turn = table.InternalRotationDeg[k],
                };
            }
            return entries;
        }

        /// The cubics of every unbroken run of usable entries of one varus value.
        void FillColumn(int column)
        {
            int start = 0, columns = _varus.Length;
            while (start < _flexion.Length)
            {
                int stop = start;
                while (stop < _flexion.Length && _entries[stop * columns + column].Known) stop++;
                if (stop - start > 1) FillRun(column, start, stop);
                start = stop + 1;
            }
        }

        void FillRun(int column, int start, int stop)
        {
            int columns = _varus.Length;
            var x = new double[stop - start];
            Array.Copy(_flexion, start, x, 0, x.Length);
            for (int i = start; i < stop - 1; i++) _curves[i * columns + column] = new Cubics();
            FillCurve(x, column, start, entry => entry.X, curve => curve.X);
            FillCurve(x, column, start, entry => entry.Y, curve => curve.Y);
            FillCurve(x, column, start, entry => entry.Z, curve => curve.Z);
            FillCurve(x, column, start, entry => entry.Turn, curve => curve.Turn);
        }

        void FillCurve(double[] x, int column, int start, Func<Found, double> value, Func<Cubics, double[]> coefficients)
        {
            int columns = _varus.Length;
            var y = new double[x.Length];
            for (int i = 0; i < y.Length; i++) y[i] = value(_entries[(start + i) * columns + column]);
            double[] slope = Spline.Slopes(x, y);
            for (int i = 0; i + 1 < x.Length; i++)
            {
                double width = x[i + 1] - x[i], chord = (y[i + 1] - y[i]) / width;
                double bend = (slope[i] + slope[i + 1] - 2.0 * chord) / width;
                double[] c = coefficients(_curves[(start + i) * columns + column]);
                c[0] = bend / width;
                c[1] = (chord - slope[i]) / width - bend;
                c[2] = slope[i];
                c[3] = y[i];
            }
        }

        Found LookUp(ref double flexion, ref double varus, Outside outside)
        {
            if (outside < Outside.Raise || outside > Outside.NaN)
                throw new ArgumentException("outside: expected Raise, Clamp or NaN");
            Found found = At(flexion, varus);
            if (found.Known || outside == Outside.NaN) return found;
            if (outside == Outside.Raise) throw new NotCoveredException(Uncovered(flexion, varus));
            ToNearestCovered(ref flexion, ref varus);
            return At(flexion, varus);
        }

        Found At(double flexion, double varus)
        {
            if (!Within(_flexion, flexion) || !Within(_varus, varus)) return Found.Nothing;
            int i = Below(_flexion, flexion), j = Below(_varus, varus);
            double along = flexion - _flexion[i], across = varus - _varus[j];
            Found near = OnColumn(i, j, along);
            if (across == 0.0 || !near.Known) return near;
            Found far = OnColumn(i, j + 1, along);
            if (!far.Known) return far;
            double weight = across / (_varus[j + 1] - _varus[j]), rest = 1.0 - weight;
            return new Found
            {
                Known = true,
                X = rest * near.X + weight * far.X,
                Y = rest * near.Y + weight * far.Y,
                Z = rest * near.Z + weight * far.Z,
                Turn = rest * near.Turn + weight * far.Turn,
            };
        }

        /// Exactly the entry where along is 0, usable or not above it.
        Found OnColumn(int i, int j, double along)
        {
            int entry = i * _varus.Length + j;
            if (along == 0.0) return _entries[entry];
            return _curves[entry] == null ? Found.Nothing : _curves[entry].At(along);
        }

        /// False for NaN.
        static bool Within(double[] axis, double value) { return value >= axis[0] && value <= axis[axis.Length - 1]; }

        static int Below(double[] axis, double value)
        {
            int at = Array.BinarySearch(axis, value);
            return at >= 0 ? at : ~at - 1;
        }

        static double Clipped(double value, double low, double high) { return Math.Min(Math.Max(value, low), high); }

        string Uncovered(double flexion, double varus)
        {
            if (!Within(_flexion, flexion)) return Beyond("flexion", flexion, FirstFlexion, LastFlexion);
            if (!Within(_varus, varus)) return Beyond("varus", varus, FirstVarus, LastVarus);
            return "the table has no stable pose at flexion " + Short(flexion) + " deg, varus " + Short(varus) + " deg";
        }

        static string Beyond(string name, double value, double first, double last)
        {
            return name + " " + Short(value) + " deg is outside the table, which covers " + Short(first) + " to "
                + Short(last) + " deg";
        }

        /// As the other players write it.
        static string Short(double value)
        {
            return double.IsNaN(value) ? "nan" : value.ToString("G6", CultureInfo.InvariantCulture);
        }

        void ToNearestCovered(ref double flexion, ref double varus)
        {
            if (double.IsNaN(flexion) || double.IsNaN(varus))
                throw new NotCoveredException("an attitude that is not a number has no nearest one");
            double endFlexion = Clipped(flexion, FirstFlexion, LastFlexion);
            double endVarus = Clipped(varus, FirstVarus, LastVarus);
            if (!At(endFlexion, endVarus).Known) SearchPieces(flexion, varus, ref endFlexion, ref endVarus);
            flexion = endFlexion;
            varus = endVarus;
        }

        /// The nearest point of every covered piece: cells, their edges, single entries; the first of equals is kept.
        void SearchPieces(double flexion, double varus, ref double nearFlexion, ref double nearVarus)
        {
            double least = double.PositiveInfinity;
            foreach (int[] size in new[] { new[] { 1, 1 }, new[] { 1, 0 }, new[] { 0, 1 }, new[] { 0, 0 } })
            {
                for (int i = 0; i + size[0] < _flexion.Length; i++)
                {
                    for (int j = 0; j + size[1] < _varus.Length; j++)
                    {
                        if (!Covered(i, j, size[0], size[1])) continue;
                        double f = Clipped(flexion, _flexion[i], _flexion[i + size[0]]);
                        double v = Clipped(varus, _varus[j], _varus[j + size[1]]);
                        double far = (f - flexion) * (f - flexion) + (v - varus) * (v - varus);
                        if (far >= least) continue;
                        least = far;
                        nearFlexion = f;
                        nearVarus = v;
                    }
                }
            }
            if (double.IsPositiveInfinity(least)) throw new NotCoveredException("the table has no usable entry");
        }

        bool Covered(int i, int j, int up, int over)
        {
            int columns = _varus.Length;
            return _entries[i * columns + j].Known && _entries[(i + up) * columns + j].Known
                && _entries[i * columns + j + over].Known && _entries[(i + up) * columns + j + over].Known;
        }

        /// scanFromReference . Rx(-flexion) Ry(varus) (Rz(turn) | d) . movingFromScan
        void Place(double flexion, double varus, Found found, double[] motion)
        {
            double turn = found.Turn * DegreesToRadians, x = found.X, y = found.Y, z = found.Z;
            double cf = Math.Cos(flexion), cv = Math.Cos(varus), cr = Math.Cos(turn);
            double sf = Math.Sin(flexion), sv = Math.Sin(varus), sr = Math.Sin(turn);
            double a = -sf * sv, b = -cf * sv;
            double[] s = _scanFromReference;
            for (int row = 0; row < 4; row++)
            {
                double p = s[4 * row], q = s[4 * row + 1], r = s[4 * row + 2], w = s[4 * row + 3];
                double along = p * (cv * x + sv * z) + q * (a * x + cf * y + sf * cv * z)
                    + r * (b * x - sf * y + cf * cv * z) + w;
                Row(row, p * cv * cr + q * (a * cr + cf * sr) + r * (b * cr - sf * sr),
                    -p * cv * sr + q * (cf * cr - a * sr) + r * (-b * sr - sf * cr),
                    p * sv + q * sf * cv + r * cf * cv, along, motion);
            }
        }

        /// One row of (left) . movingFromScan; left = (p, q, r, w).
        void Row(int row, double p, double q, double r, double w, double[] motion)
        {
            double[] m = _movingFromScan;
            for (int k = 0; k < 4; k++) motion[4 * row + k] = p * m[k] + q * m[4 + k] + r * m[8 + k] + w * m[12 + k];
        }

        /// Of an orthonormal frame, left-handed ones included: transposed axes, and the shift turned back.
        static double[] RigidInverse(double[] m)
        {
            var inverse = new double[16];
            for (int i = 0; i < 3; i++)
            {
                for (int j = 0; j < 3; j++) inverse[4 * i + j] = m[4 * j + i];
                inverse[4 * i + 3] = -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
            }
            inverse[15] = 1.0;
            return inverse;
        }
    }

    /// <summary>The cubic with not-a-knot ends (de Boor, A Practical Guide to Splines).</summary>
    static class Spline
    {
        /// <summary>First derivatives at two or more samples: two give a line, three a parabola.</summary>
        public static double[] Slopes(double[] x, double[] y)
        {
            int n = x.Length;
            var width = new double[n - 1];
            var chord = new double[n - 1];
            for (int i = 0; i < n - 1; i++)
            {
                width[i] = x[i + 1] - x[i];
                chord[i] = (y[i + 1] - y[i]) / width[i];
            }
            if (n == 2) return new[] { chord[0], chord[0] };
            var lower = new double[n];
            var middle = new double[n];
            var upper = new double[n];
            var right = new double[n];
            for (int i = 1; i < n - 1; i++)
            {
                lower[i] = width[i];
                middle[i] = 2.0 * (width[i - 1] + width[i]);
                upper[i] = width[i - 1];
                right[i] = 3.0 * (width[i] * chord[i - 1] + width[i - 1] * chord[i]);
            }
            int last = n - 2;
            End(width[0], width[1], chord[0], chord[1], n, out middle[0], out upper[0], out right[0]);
            End(width[last], width[last - 1], chord[last], chord[last - 1], n,
                out middle[n - 1], out lower[n - 1], out right[n - 1]);
            return Solved(lower, middle, upper, right);
        }

        /// Weights of the end sample's slope and its neighbour's, and the right-hand side.
        static void End(double first, double second, double nearChord, double farChord, int samples,
            out double own, out double neighbour, out double right)
        {
            if (samples == 3)
            {
                own = 1.0;
                neighbour = 1.0;
                right = 2.0 * nearChord;
                return;
            }
            double both = first + second;
            own = second;
            neighbour = both;
            right = (first + 2.0 * both) * second / both * nearChord + first * first / both * farChord;
        }

        /// Tridiagonal elimination; every pivot of these equations is positive.
        static double[] Solved(double[] lower, double[] middle, double[] upper, double[] right)
        {
            int n = right.Length;
            for (int i = 1; i < n; i++)
            {
                double factor = lower[i] / middle[i - 1];
                middle[i] -= factor * upper[i - 1];
                right[i] -= factor * right[i - 1];
            }
            right[n - 1] /= middle[n - 1];
            for (int i = n - 2; i >= 0; i--) right[i] = (right[i] - upper[i] * right[i + 1]) / middle[i];
            return right;
        }
    }

    /// <summary>A place and a rotation in Unity: metres, unit quaternion (x, y, z, w).</summary>
    public struct UnityPlacement
    {
        public double X, Y, Z, QX, QY, QZ, QW;
    }

    /// <summary>From scan space (LPS mm, right-handed) to Unity's (metres, left-handed): Unity x is the patient's right,
    /// y up the body, z forward, so that a standing patient looks along +z as a Unity character does.
    ///
    /// Unity (x, y, z) = (-x, z, -y) / 1000 of LPS. The map exchanges the hands, so the corners of every triangle change
    /// their order to a, c, b; otherwise surfaces are seen from inside. The exported .glb has x to the left, y up, z
    /// forward, so an importer that negates the x of glTF comes to the same axes; one that negates another axis does
    /// not.</summary>
    public static class UnitySpace
    {
        const double Metres = 0.001;

        /// <summary>A point of scan space, mm, in Unity, metres: x, y, z.</summary>
        public static double[] Point(double x, double y, double z)
        {
            return new[] { -x * Metres, z * Metres, -y * Metres };
        }

        /// <summary>A motion of scan space (16 numbers row by row, as Player.Pose gives it) as a Unity placement of a
        /// mesh whose vertices were made with Point.</summary>
        public static UnityPlacement Placement(double[] m)
        {
            // rows and columns in the order x, z, y with the signs of the map
            double[] r =
            {
                m[0], -m[2], m[1],
                -m[8], m[10], -m[9],
                m[4], -m[6], m[5],
            };
            var at = new UnityPlacement { X = -m[3] * Metres, Y = m[11] * Metres, Z = -m[7] * Metres };
            Turn(r, ref at);
            return at;
        }

        /// The quaternion of a rotation matrix, by its largest component.
        static void Turn(double[] r, ref UnityPlacement at)
        {
            double w = 1.0 + r[0] + r[4] + r[8], x = 1.0 + r[0] - r[4] - r[8];
            double y = 1.0 - r[0] + r[4] - r[8], z = 1.0 - r[0] - r[4] + r[8];
            double most = Math.Max(Math.Max(w, x), Math.Max(y, z)), scale = 0.5 / Math.Sqrt(most);
            double yz = r[7] - r[5], zx = r[2] - r[6], xy = r[3] - r[1];
            double sumXY = r[1] + r[3], sumZX = r[2] + r[6], sumYZ = r[5] + r[7];
            if (most == w) Set(ref at, scale, yz, zx, xy, most);
            else if (most == x) Set(ref at, scale, most, sumXY, sumZX, yz);
            else if (most == y) Set(ref at, scale, sumXY, most, sumYZ, zx);
            else Set(ref at, scale, sumZX, sumYZ, most, xy);
        }

        static void Set(ref UnityPlacement at, double scale, double x, double y, double z, double w)
        {
            at.QX = scale * x;
            at.QY = scale * y;
            at.QZ = scale * z;
            at.QW = scale * w;
        }
    }

    /// <summary>The little of JSON that a table needs.</summary>
    static class Json
    {
        const int Deepest = 32;

        /// <summary>Dictionary, List, string, double, bool or null. Throws FormatException.</summary>
        public static object Parse(string text)
        {
            int at = 0;
            object value = Value(text, ref at, 0);
            if (Next(text, ref at) != '\0') throw Wrong(at);
            return value;
        }

        public static object Member(Dictionary<string, object> all, string name)
        {
            object value;
            if (!all.TryGetValue(name, out value)) throw new FormatException("the table lacks " + name);
            return value;
        }

        /// <summary>A member that is an object; all itself where there is none.</summary>
        public static Dictionary<string, object> Section(Dictionary<string, object> all, string name)
        {
            object value;
            return all.TryGetValue(name, out value) ? value as Dictionary<string, object> ?? all : all;
        }

        /// <summary>An array of numbers, or of rows of numbers, row by row; NaN for null.</summary>
        public static double[] Numbers(Dictionary<string, object> all, string name)
        {
            var flat = new List<double>();
            Flatten(Member(all, name), flat, name);
            return flat.ToArray();
        }

        static void Flatten(object value, List<double> flat, string name)
        {
            var rows = value as List<object>;
            if (rows != null) foreach (object row in rows) Flatten(row, flat, name);
            else if (value == null) flat.Add(double.NaN);
            else if (value is double) flat.Add((double)value);
            else throw new FormatException(name + ": expected numbers");
        }

        static object Value(string text, ref int at, int depth)
        {
            if (depth > Deepest) throw Wrong(at);
            char next = Next(text, ref at);
            if (next == '{') return Object(text, ref at, depth);
            if (next == '[') return List(text, ref at, depth);
            if (next == '"') return String(text, ref at);
            if (Word(text, ref at, "null")) return null;
            if (Word(text, ref at, "true")) return true;
            if (Word(text, ref at, "false")) return false;
            return Number(text, ref at);
        }

        static Dictionary<string, object> Object(string text, ref int at, int depth)
        {
            var all = new Dictionary<string, object>();
            at++;
            if (Skip(text, ref at, '}')) return all;
            do
            {
                if (Next(text, ref at) != '"') throw Wrong(at);
                string name = String(text, ref at);
                if (!Skip(text, ref at, ':')) throw Wrong(at);
                all[name] = Value(text, ref at, depth + 1);
            }
            while (Skip(text, ref at, ','));
            if (!Skip(text, ref at, '}')) throw Wrong(at);
            return all;
        }

        static List<object> List(string text, ref int at, int depth)
        {
            var all = new List<object>();
            at++;
            if (Skip(text, ref at, ']')) return all;
            do all.Add(Value(text, ref at, depth + 1));
            while (Skip(text, ref at, ','));
            if (!Skip(text, ref at, ']')) throw Wrong(at);
            return all;
        }

        static string String(string text, ref int at)
        {
            var word = new StringBuilder();
            for (at++; at < text.Length && text[at] != '"'; at++)
                word.Append(text[at] == '\\' ? Escaped(text, ref at) : text[at]);
            if (at++ >= text.Length) throw Wrong(at);
            return word.ToString();
        }

        static char Escaped(string text, ref int at)
        {
            if (++at >= text.Length) throw Wrong(at);
            int known = "\"\\/bfnrt".IndexOf(text[at]);
            if (known >= 0) return "\"\\/\b\f\n\r\t"[known];
            ushort code;
            if (text[at] != 'u' || at + 4 >= text.Length || !ushort.TryParse(text.Substring(at + 1, 4),
                NumberStyles.AllowHexSpecifier, CultureInfo.InvariantCulture, out code)) throw Wrong(at);
            at += 4;
            return (char)code;
        }

        static object Number(string text, ref int at)
        {
            int start = at;
            while (at < text.Length && "+-.eE0123456789".IndexOf(text[at]) >= 0) at++;
            double value;
            string word = text.Substring(start, at - start);
            if (!double.TryParse(word, NumberStyles.Float, CultureInfo.InvariantCulture, out value)) throw Wrong(start);
            return value;
        }

        static bool Word(string text, ref int at, string word)
        {
            if (string.CompareOrdinal(text, at, word, 0, word.Length) != 0) return false;
            at += word.Length;
            return true;
        }

        static bool Skip(string text, ref int at, char wanted)
        {
            if (Next(text, ref at) != wanted) return false;
            at++;
            return true;
        }

        /// The next character that is not blank; '\0' at the end.
        static char Next(string text, ref int at)
        {
            while (at < text.Length && " \t\r\n\uFEFF".IndexOf(text[at]) >= 0) at++;
            return at < text.Length ? text[at] : '\0';
        }

        static FormatException Wrong(int at) { return new FormatException("not JSON at character " + at); }
    }
}
