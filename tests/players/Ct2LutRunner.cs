// Asks the C# player what a test wants to know: Ct2LutRunner TABLE.json, one question a line on standard input.
//
//   pose FLEXION VARUS POLICY         -> 16 numbers
//   coordinates FLEXION VARUS POLICY  -> flexion varus rotation lateral anterior proximal
//   unity FLEXION VARUS POLICY        -> position and quaternion of the pose
//   point X Y Z                       -> the point in Unity
//
// An exception of the player is answered with "refused " and its message.

using System;
using System.Globalization;
using System.IO;
using System.Linq;
using Ct2Lut;

static class Ct2LutRunner
{
    static int Main(string[] arguments)
    {
        Player player;
        try
        {
            player = Player.FromJson(File.ReadAllText(arguments[0]));
        }
        catch (Exception error) when (error is FormatException || error is ArgumentException)
        {
            Console.WriteLine("refused " + error.Message);
            return 0;
        }
        string line;
        while ((line = Console.ReadLine()) != null) Console.WriteLine(Answer(player, line.Split(' ')));
        return 0;
    }

    static string Answer(Player player, string[] words)
    {
        double first = Number(words[1]), second = Number(words[2]);
        if (words[0] == "point") return Text(UnitySpace.Point(first, second, Number(words[3])));
        Outside outside;
        if (!Enum.TryParse(words[3], true, out outside)) outside = (Outside)99;
        try
        {
            if (words[0] == "pose") return Text(player.Pose(first, second, outside));
            if (words[0] == "unity") return Text(Placed(UnitySpace.Placement(player.Pose(first, second, outside))));
            Coordinates at = player.Coordinates(first, second, outside);
            return Text(at.FlexionDeg, at.VarusDeg, at.InternalRotationDeg, at.LateralMm, at.AnteriorMm, at.ProximalMm);
        }
        catch (Exception error) when (error is NotCoveredException || error is ArgumentException)
        {
            return "refused " + error.Message;
        }
    }

    static double[] Placed(UnityPlacement at) { return new[] { at.X, at.Y, at.Z, at.QX, at.QY, at.QZ, at.QW }; }

    static double Number(string word)
    {
        return word == "nan" ? double.NaN : double.Parse(word, NumberStyles.Float, CultureInfo.InvariantCulture);
    }

    static string Text(params double[] numbers)
    {
        return string.Join(" ", numbers.Select(
            one => double.IsNaN(one) ? "nan" : one.ToString("R", CultureInfo.InvariantCulture)));
    }
}
