// A spring and a damper against a finger, whose stiffness (N/mm) and damping (N s/mm) a hilbo session chooses.
//
//     hilbo init spring.toml --parameter stiffness=0.1:2:N/mm --parameter damping=0.001:0.02:N.s/mm
//     hilbo doctor spring.toml --stimulus                        # prints a link: measures how fast this program stops
//     mcs ExampleSpring.cs HilboStimulus.cs -out:ExampleSpring.exe && mono ExampleSpring.exe LINK-OF-THE-STIMULUS
//
// The loop stands for the one of your device: it reads a position (here of a finger that is simulated), and sets a force
// (here none is set). What has to be the same in yours: goNeutral only replaces a value, the loop looks at it in each
// tick, and contact is reported as the loop detects it.

using System;
using System.Diagnostics;
using System.Globalization;
using System.Threading;

static class ExampleSpring {
    sealed class Spring {
        public double Stiffness, Damping;
    }

    static readonly Spring None = new Spring(), Reference = new Spring { Stiffness = 0.8, Damping = 0.005 };
    static volatile Spring now = None;  // replaced as one
    static volatile bool ended;

    // A force in N: here for your motor's call.
    static void SetMotor(double force) {}

    // Until the program ends; on stderr when the spring comes and goes.
    static void Loop(Hilbo.Stimulus stimulus) {
        bool touched = false, pushed = false;
        var begun = Stopwatch.StartNew();
        while (!ended) {
            double phase = 2 * Math.PI * begun.Elapsed.TotalSeconds / 0.6;  // a finger that comes every 0.6 s
            double x = 4 * Math.Sin(phase) - 2, v = 4 * Math.Cos(phase) * 2 * Math.PI / 0.6;  // mm, mm/s
            var spring = now;
            SetMotor(x > 0 ? spring.Stiffness * x + spring.Damping * v : 0);
            if (x > 0 != touched) stimulus.Contact = touched = x > 0;
            if (spring.Stiffness > 0 != pushed) {
                pushed = spring.Stiffness > 0;
                var at = Hilbo.Stimulus.Now.ToString("F3", CultureInfo.InvariantCulture);
                Console.Error.WriteLine(at + (pushed ? " force" : " neutral"));
            }
            Thread.Sleep(1);
        }
    }

    static void Present(Hilbo.Stimulus stimulus) {
        Hilbo.Order order;
        while (stimulus.Next(out order)) {
            if (order.What != "present") {
                now = None;
                stimulus.Neutral();
            } else {
                now = order.Show != "test" ? Reference
                    : new Spring { Stiffness = order.Values["stiffness"], Damping = order.Values["damping"] };
                stimulus.Presented();
            }
        }
    }

    static int Main(string[] words) {
        if (words.Length != 1) {
            Console.Error.WriteLine("usage: ExampleSpring LINK, the one that hilbo session prints for the stimulus");
            return 2;
        }
        try {
            using (var stimulus = new Hilbo.Stimulus(words[0], "example_spring.cs", "1", true, () => now = None, 0.05)) {
                var looping = new Thread(() => Loop(stimulus)) { IsBackground = true };
                looping.Start();
                try {
                    Present(stimulus);
                } finally {
                    now = None;
                    ended = true;
                    looping.Join();
                }
            }
            return 0;
        } catch (Hilbo.StimulusException error) {
            Console.Error.WriteLine(error.Message);
            return 1;
        }
    }
}
