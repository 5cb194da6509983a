// SagsClient without Unity, e.g. with Debian's mono:
//
//     mcs -r:System.Runtime.Serialization.dll SagsClient.cs Program.cs -out:sags.exe
//     mono sags.exe ws://127.0.0.1:8766/ws 10
//
// Prints one line for each frame, and "stale" once when there is nothing new to show.

using System;
using System.Linq;
using System.Threading;
using Sags;

public static class Program {
    const string Image = "sags/left/render/image", Depth = "sags/left/render/depth", Pins = "sags/anchors";

    public static void Main(string[] args) {
        System.Globalization.CultureInfo.CurrentCulture = System.Globalization.CultureInfo.InvariantCulture; // 0.1, not 0,1
        int frames = args.Length > 1 ? int.Parse(args[1]) : int.MaxValue;
        long shown = 0;
        bool stale = false;
        using (var client = new SagsClient(args.Length > 0 ? args[0] : "ws://127.0.0.1:8766/ws", 0.4, Image, Depth, Pins))
            while (frames > 0) {
                Thread.Sleep(2);
                string why, whyDepth, whyPins;
                Message image = client.Fresh(Image, out why), depth = client.Fresh(Depth, out whyDepth), pins = client.Fresh(Pins, out whyPins);
                bool none = image == null || depth == null || pins == null; // draw nothing then: it must not look like now
                if (none && !stale) Console.WriteLine("stale: " + (image == null ? why : depth == null ? whyDepth : whyPins));
                stale = none;
                if (none || new[] { image, pins }.Any(each => each.Head.stamp_ns != depth.Head.stamp_ns)) continue;
                if (depth.Head.stamp_ns == shown) continue;
                int height = depth.Head.shape[0], width = depth.Head.shape[1], centre = height / 2 * width + width / 2;
                var rgba = string.Join(",", image.Data.Skip(4 * centre).Take(4));
                var found = string.Join(";", pins.Anchors().Select(pin => pin.Id + ":" + pin.Z + ":" + pin.Visibility + ":" + pin.DepthConfidence));
                string said = depth.Head.units == null ? "depth_mm=" + 1000 * depth.FloatAt(centre) : "depth_no_unit=" + depth.FloatAt(centre);
                Console.WriteLine("stamp_ns={0} shape={1}x{2} {3} rgba={4} anchors={5}", depth.Head.stamp_ns, height, width, said, rgba, found);
                shown = depth.Head.stamp_ns;
                frames--;
            }
    }
}
