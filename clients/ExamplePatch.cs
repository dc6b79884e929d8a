// A patch of colour in the terminal, whose hue (degrees) and light (%) a hilbo session chooses.
//
//     hilbo init colour.toml --name colour --parameter hue=140:260:deg --parameter light=20:80:%
//     hilbo session colour.toml --participant P01 --dry-run      # in another terminal: prints the links
//     mcs ExamplePatch.cs HilboStimulus.cs -out:ExamplePatch.exe && mono ExamplePatch.exe LINK-OF-THE-STIMULUS
//
// The reference is a patch of a hidden colour.

using System;
using System.Collections.Generic;

static class ExamplePatch {
    // Red (0), green (8) or blue (4), of 255, of a colour whose saturation is 0.7.
    static int Part(double hue, double light, int which) {
        double k = (which + hue / 30) % 12, room = 0.7 * Math.Min(light, 100 - light) / 100;
        return (int)(255 * (light / 100 - room * Math.Max(-1, Math.Min(Math.Min(k - 3, 9 - k), 1))));
    }

    // A patch under a title; an empty screen without values.
    static void Draw(string title, IDictionary<string, double> values) {
        Console.Write("\x1b[2J\x1b[H" + title + "\n");
        for (var row = 0; values != null && row < 12; row++) {
            double hue = values["hue"], light = values["light"];
            var colour = Part(hue, light, 0) + ";" + Part(hue, light, 8) + ";" + Part(hue, light, 4);
            Console.Write("\x1b[48;2;" + colour + "m" + new string(' ', 40) + "\x1b[0m\n");
        }
        Console.Out.Flush();
    }

    static void Present(Hilbo.Stimulus stimulus) {
        var reference = new Dictionary<string, double> { { "hue", 205 }, { "light", 45 } };
        Hilbo.Order order;
        while (stimulus.Next(out order)) {
            if (order.What != "present") {
                Draw("", null);
                stimulus.Neutral();
            } else if (order.Show == "reference") {
                Draw("Reference", reference);
                stimulus.Presented();
            } else if (!order.Values.ContainsKey("hue") || !order.Values.ContainsKey("light")) {
                stimulus.Failed("this patch has hue and light");
            } else {
                Draw("Test", order.Values);
                stimulus.Presented(order.Values);  // the values really presented: here, the requested ones
            }
        }
    }

    static int Main(string[] words) {
        if (words.Length != 1) {
            Console.Error.WriteLine("usage: ExamplePatch LINK, the one that hilbo session prints for the stimulus");
            return 2;
        }
        try {
            using (var stimulus = new Hilbo.Stimulus(words[0], "example_patch.cs", "1", neutralWithinS: 0.2))
                Present(stimulus);
            return 0;
        } catch (Hilbo.StimulusException error) {
            Console.Error.WriteLine(error.Message);
            return 1;
        }
    }
}
