// Present the stimuli of a hilbo session from a C# program, for instance in Unity.
//
// hilbo does not guard your actuators, and certifies nothing about them. If your program moves something that people
// touch, an independent hardware stop within reach of the hand must be provided by you.
//
// One file, for .NET Standard 2.0 or newer (Unity 2018.1 or newer), which needs nothing else: copy it into your project.
//
//     using (var stimulus = new Hilbo.Stimulus(link, "my scene", "1.0")) {
//         Hilbo.Order order;
//         while (stimulus.Next(out order)) {
//             if (order.What == "present") {
//                 Show(order.Show, order.Values);  // "test" with values, "reference" without
//                 stimulus.Presented();            // or Presented(values): the values really presented
//             } else {
//                 Blank();
//                 stimulus.Neutral();
//             }
//         }
//     }
//
// In Unity: `if (stimulus.Next(out order, 0))` in Update, and Dispose in OnDestroy; ExampleUnity.cs does so. Presented,
// Neutral and Failed wait for the server's answer, some ms, and for silence_s where it does not come.
//
// A program that moves something gives force and goNeutral, a function that takes away all force. It is called by
// threads of this file, one at a time: as soon as the server orders it, when the connection fails, and at the latest
// 50 ms after the server has been silent for the time that it states (SilenceS, 1 s by default). Set
// Contact while a hand touches what you move: no order to present is handed to you meanwhile. In Unity goNeutral must
// not touch scene objects, which belong to the main thread. docs/guides/stimulus.md of hilbo has the protocol.

using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.Net.Sockets;
using System.Text;
using System.Threading;

namespace Hilbo {

/// <summary>The session refuses this program, with the reason.</summary>
public class StimulusException : Exception {
    public StimulusException(string why) : base(why) {}
}

/// <summary>What shall be the case from now on. What: "present", "neutral" (show nothing, push nothing) or "stop" (the
/// same, at once). Show: "test", with the Values of its parameters in the study's units, or "reference"; Side: "a" or
/// "b" where two tests are compared. It has to be confirmed within WithinS.</summary>
public class Order {
    public long Number;
    public string What = "neutral", Show = "", Side = "", Trial = "";
    public int Step;
    public double WithinS;
    public readonly Dictionary<string, double> Values = new Dictionary<string, double>();  // NaN for a level
    public readonly Dictionary<string, string> Texts = new Dictionary<string, string>();  // as it is sent: a level's name
}

public class Parameter {
    public string Name, Unit;
    public double Low, High, Tolerance;
    public string[] Levels;  // the names of what has no order; null of numbers
}

/// <summary>This program's part in a session.</summary>
public sealed class Stimulus : IDisposable {
    readonly string _hello, _key;
    readonly bool _force;
    readonly Action _goNeutral;
    readonly Action<string> _log;
    string _again = "";  // its own run, whose place it takes at once where the line broke
    readonly Line _own, _talking;  // the program's connection, and that of the thread that talks
    readonly Thread _talk, _watch;
    readonly object _saying = new object(), _going = new object(), _lock = new object();  // the last: of what follows
    string _run = "", _why = "";
    Order _order = new Order(), _handed = new Order();
    long _doneNumber;
    string _done = "busy";  // what was done about the order of that number
    Parameter[] _parameters = new Parameter[0];
    readonly Stopwatch _heard = Stopwatch.StartNew();
    double _silenceS = 1;
    bool _contact, _closed;

    /// <param name="link">The one that `hilbo session` prints for the stimulus, for one program at a time.</param>
    /// <param name="neutralWithinS">So soon is everything neutral after goNeutral was called, or after an order.</param>
    /// <param name="log">Told what goes wrong; by default it is on stderr, with the time in s since 1970.</param>
    /// <exception cref="StimulusException">The session does not let it in.</exception>
    public Stimulus(string link, string name, string version = "", bool force = false, Action goNeutral = null,
                    double neutralWithinS = 1, Action<string> log = null) {
        if (force && goNeutral == null)
            throw new ArgumentException("A program with force gives goNeutral, which takes all force away.");
        Uri uri;
        if (!Uri.TryCreate(link, UriKind.Absolute, out uri) || uri.Fragment.Length < 2)
            throw new StimulusException("The link is not one that hilbo session has printed: http://…:…/#…");
        _force = force;
        _goNeutral = goNeutral;
        _log = log ?? (words => Console.Error.WriteLine(Text(Now) + " hilbo_stimulus: " + words));
        _own = new Line(uri.Host, uri.Port);
        _talking = new Line(uri.Host, uri.Port);
        _hello = "name=" + Uri.EscapeDataString(name) + "&version=" + Uri.EscapeDataString(version)
            + "&force=" + (force ? "true" : "false") + "&neutral_within_s=" + Text(neutralWithinS);
        var found = _own.Post("/api/join", "bearer=true&token=" + uri.Fragment.Substring(1), "", 10);
        if (Field(found, "role") != "stimulus") {
            var why = Field(found, "error");
            throw new StimulusException(why == "" ? "This link is not the one for the stimulus." : why);
        }
        _key = Field(found, "key");
        _talk = new Thread(Talk) { IsBackground = true };
        _watch = new Thread(Watch) { IsBackground = true };
        _talk.Start();
        _watch.Start();
    }

    /// <summary>The newest order that was not handed out yet, once there is one; false after timeoutS, or when it is
    /// disposed of.</summary>
    /// <exception cref="StimulusException">This program is no longer part of the session.</exception>
    public bool Next(out Order order, double timeoutS = 1e6) {
        var begun = Stopwatch.StartNew();
        lock (_lock) {
            while (!_closed && _why == "" && !Due) {
                var left = timeoutS - begun.Elapsed.TotalSeconds;
                if (left <= 0) break;
                Monitor.Wait(_lock, TimeSpan.FromSeconds(left));
            }
            order = null;
            if (_why != "") throw new StimulusException(_why);
            if (_closed || !Due) return false;
            order = _handed = _order;
            return true;
        }
    }

    /// <summary>The newest order, for programs that look at every frame.</summary>
    public Order Order { get { lock (_lock) return _order; } }

    /// <summary>Whether a hand touches the moving part.</summary>
    public bool Contact {
        get { lock (_lock) return _contact; }
        set { lock (_lock) { _contact = value; Monitor.PulseAll(_lock); } }
    }

    /// <summary>Of the study; after the first order was handed out.</summary>
    public Parameter[] Parameters { get { lock (_lock) return _parameters; } }

    public double SilenceS { get { lock (_lock) return _silenceS; } }

    /// <summary>What the last order asked for is shown from now on, with these numbers and levels (by default those
    /// asked for). False if that is not taken: too late, too far off, another level; the trial is void then.</summary>
    public bool Presented(IDictionary<string, double> values = null, IDictionary<string, string> levels = null) {
        Dictionary<string, string> texts;
        lock (_lock) texts = new Dictionary<string, string>(_handed.Texts);
        if (levels != null) foreach (var level in levels) texts[level.Key] = level.Value;
        if (values != null) {
            foreach (var value in values) {
                string asked;
                if (double.IsNaN(value.Value) && texts.TryGetValue(value.Key, out asked) && double.IsNaN(Number(asked)))
                    continue;  // a level
                if (double.IsNaN(value.Value) || double.IsInfinity(value.Value))
                    throw new ArgumentException(value.Key + " is no number.");
                texts[value.Key] = Text(value.Value);
            }
        }
        return Say("presented", texts, "");
    }

    /// <summary>Nothing is shown, and nothing pushes, from now on.</summary>
    public bool Neutral() { return Say("neutral", null, ""); }

    /// <summary>What the last order asked for cannot be shown; the trial is void.</summary>
    public bool Failed(string why) {
        return Say("failed", null, "&why=" + Uri.EscapeDataString(why.Substring(0, Math.Min(500, why.Length))));
    }

    /// <summary>Go neutral, and leave.</summary>
    public void Dispose() {
        lock (_lock) {
            if (_closed) return;
            _closed = true;
            Monitor.PulseAll(_lock);
        }
        GoNeutral();
        foreach (var thread in new[] { _talk, _watch }) if (thread != Thread.CurrentThread) thread.Join();
        _own.Close();
        _talking.Close();
    }

    bool Due { get { return _order != _handed && !(_force && _contact && _order.What == "present"); } }

    bool Over { get { lock (_lock) return _closed || _why != ""; } }

    // Says how things are, again and again, and keeps the newest order.
    void Talk() {
        while (!Over) {
            try {
                Order order;
                string state, run;
                double wait;
                lock (_lock) {
                    order = _order;
                    run = _run;
                    state = _doneNumber == order.Number ? _done : "busy";
                    wait = _force ? 0.05 : _silenceS / 3;
                }
                if (run == "") Begin();
                else Report(_talking, order, state, null, "&wait_s=" + Text(wait));
            } catch (Exception error) {
                Lost(error.Message);
                Thread.Sleep(200);
            }
        }
    }

    // Nobody waits longer for a server that says nothing than it stated.
    void Watch() {
        while (!Over) {
            Thread.Sleep((int)Math.Ceiling(Math.Min(50, 100 * SilenceS)));
            bool silent;
            lock (_lock) silent = _run != "" && _heard.Elapsed.TotalSeconds > _silenceS;
            if (silent) Lost("the server is silent");
        }
    }

    void Begin() {
        var found = _talking.Post("/api/stimulus/hello", _hello + _again, _key, SilenceS);
        var status = Field(found, "status");
        if (status == "400" || status == "401" || status == "403") {
            End(Field(found, "error"));
        } else if (status != "200") {
            throw new StimulusException("the session is not ready");
        } else {
            var run = Field(found, "run");
            _again = "&run=" + Uri.EscapeDataString(run);
            lock (_lock) {
                _parameters = Array.ConvertAll(found.FindAll(IsParameter).ToArray(), ParameterOf);
                _silenceS = Number(Field(found, "silence_s"));
                _heard.Restart();
                _run = run;
            }
            Take(run, found);
        }
    }

    // A report from the program's own thread; whether it was taken.
    bool Say(string state, Dictionary<string, string> values, string more) {
        Order order;
        lock (_lock) {
            order = _handed;
            if (order != _order) return false;     // it is over; the next one is there already
            if (order.Number == 0) return true;    // there is no server to send it to
        }
        try {
            lock (_saying) if (!Report(_own, order, state, values, more)) return false;
        } catch (Exception error) {
            Lost(error.Message);
            return false;
        }
        lock (_lock) {
            _doneNumber = order.Number;
            _done = state;
        }
        return true;
    }

    // Says how things are; whether that was taken.
    bool Report(Line line, Order order, string state, Dictionary<string, string> values, string more) {
        string run;
        bool contact;
        lock (_lock) {
            run = _run;
            contact = _contact;
        }
        if (run == "") return false;
        var form = new StringBuilder("run=" + run + "&order=" + order.Number.ToString(CultureInfo.InvariantCulture));
        form.Append("&state=" + state + "&contact=" + (contact ? "true" : "false") + more);
        if (state == "presented") form.Append("&trial=" + Uri.EscapeDataString(order.Trial));
        if (values != null)
            foreach (var value in values)
                form.Append("&value." + Uri.EscapeDataString(value.Key) + "=" + Uri.EscapeDataString(value.Value));
        var found = line.Post("/api/stimulus", form.ToString(), _key, SilenceS);
        string status = Field(found, "status"), error = Field(found, "error");
        if (status != "200") _log(error);
        if (status == "401" || status == "403") End(error);
        else if (Field(found, "order") != "") Take(run, found);
        else if (status == "409") Lost(error);     // another server, or one that gave this program up
        return status == "200";
    }

    // A new order of the run that goes on; one that asks for it is neutral at once.
    void Take(string run, List<string[]> found) {
        Order order;
        lock (_lock) {
            if (run != _run) return;               // it came after the silence
            _heard.Restart();
            order = OrderOf(found);
            if (order.Number <= _order.Number) return;
            _order = order;
            Monitor.PulseAll(_lock);
        }
        if (order.What != "present" && _goNeutral != null && GoNeutral()) {
            lock (_lock) {
                _doneNumber = order.Number;
                _done = "neutral";
            }
        }
    }

    bool GoNeutral() {
        lock (_going) {
            try {
                if (_goNeutral != null) _goNeutral();
                return true;
            } catch (Exception error) {
                _log("goNeutral failed: " + error.Message);
                return false;
            }
        }
    }

    // There is no server to be heard: neutral, and said to your program as an order.
    void Lost(string why) {
        lock (_lock) {
            if (_run == "" || _closed) return;
            _run = "";
            _order = new Order();
            Monitor.PulseAll(_lock);
        }
        GoNeutral();
        _log("neutral: " + why);
    }

    void End(string why) {
        lock (_lock) {
            _why = why;
            Monitor.PulseAll(_lock);
        }
        GoNeutral();
    }

    // What is in an answer: lines of fields.

    static Order OrderOf(List<string[]> found) {
        var order = new Order { Number = (long)Number(Field(found, "order")), What = Field(found, "do") };
        if (order.What != "present") return order;
        order.Show = Field(found, "show");
        order.Side = Field(found, "side");
        order.Trial = Field(found, "trial");
        order.Step = (int)Number(Field(found, "step"));
        order.WithinS = Number(Field(found, "within_s"));
        foreach (var line in found.FindAll(line => line[0] == "value")) {
            order.Texts[line[1]] = line[2];
            order.Values[line[1]] = Number(line[2]);
        }
        return order;
    }

    static bool IsParameter(string[] line) { return line[0] == "parameter" || line[0] == "levels"; }

    static Parameter ParameterOf(string[] line) {
        if (line[0] == "levels") {
            var levels = new string[line.Length - 2];
            Array.Copy(line, 2, levels, 0, levels.Length);
            return new Parameter { Name = line[1], Unit = "", Levels = levels };
        }
        return new Parameter { Name = line[1], Low = Number(line[2]), High = Number(line[3]), Tolerance = Number(line[4]),
                               Unit = line[5] };
    }

    static string Field(List<string[]> found, string name) {
        var line = found.Find(one => one[0] == name && one.Length > 1);
        return line == null ? "" : line[1];
    }

    static double Number(string word) {
        double value;
        return double.TryParse(word, NumberStyles.Float, CultureInfo.InvariantCulture, out value) ? value : double.NaN;
    }

    static string Text(double value) { return value.ToString("R", CultureInfo.InvariantCulture); }

    /// <summary>s since 1970, UTC.</summary>
    public static double Now {
        get { return (DateTime.UtcNow - new DateTime(1970, 1, 1, 0, 0, 0, DateTimeKind.Utc)).TotalSeconds; }
    }

    // One connection to the server, made when it is needed, and again after a failure. Used by one thread at a time.
    sealed class Line {
        readonly string _host;
        readonly int _port;
        Socket _socket;

        public Line(string host, int port) {
            _host = host;
            _port = port;
        }

        // The answer to a form.
        public List<string[]> Post(string path, string form, string key, double seconds) {
            try {
                var begun = Stopwatch.StartNew();
                if (_socket == null) Connect(seconds);
                var head = "POST " + path + " HTTP/1.1\r\nHost: " + _host + ":" + _port + "\r\nContent-Type: "
                    + "application/x-www-form-urlencoded\r\n" + (key == "" ? "" : "Authorization: Bearer " + key + "\r\n")
                    + "Content-Length: " + form.Length + "\r\n\r\n";
                _socket.SendTimeout = (int)(1000 * seconds);
                _socket.Send(Encoding.ASCII.GetBytes(head + form));
                return Answer(begun, seconds);
            } catch {
                Close();
                throw;
            }
        }

        public void Close() {
            if (_socket != null) _socket.Close();
            _socket = null;
        }

        void Connect(double seconds) {
            var socket = new Socket(AddressFamily.InterNetwork, SocketType.Stream, ProtocolType.Tcp) { NoDelay = true };
            var connecting = socket.BeginConnect(_host, _port, null, null);
            if (!connecting.AsyncWaitHandle.WaitOne(TimeSpan.FromSeconds(seconds))) {
                socket.Close();
                throw new StimulusException("the server does not answer");
            }
            socket.EndConnect(connecting);
            _socket = socket;
        }

        List<string[]> Answer(Stopwatch begun, double seconds) {
            var bytes = new List<byte>();
            int head = -1, length = 0;
            var last = false;
            while (head < 0 || bytes.Count < head + length) {
                var part = new byte[4096];
                var left = (int)(1000 * (seconds - begun.Elapsed.TotalSeconds));
                if (left <= 0) throw new StimulusException("the server does not answer");
                _socket.ReceiveTimeout = left;
                var got = _socket.Receive(part);
                if (got == 0) throw new StimulusException("the server has ended the connection");
                for (var i = 0; i < got; i++) bytes.Add(part[i]);
                var text = Encoding.ASCII.GetString(bytes.ToArray());
                var end = text.IndexOf("\r\n\r\n", StringComparison.Ordinal);
                if (head >= 0 || end < 0) continue;
                head = end + 4;
                foreach (var line in text.Substring(0, end).ToLowerInvariant().Split('\n')) {
                    if (line.StartsWith("content-length:", StringComparison.Ordinal))
                        length = int.Parse(line.Substring(15).Trim(), CultureInfo.InvariantCulture);
                    if (line.StartsWith("connection: close", StringComparison.Ordinal)) last = true;
                }
            }
            if (last) Close();
            var found = new List<string[]>();
            foreach (var line in Encoding.UTF8.GetString(bytes.ToArray(), head, length).Split('\n'))
                found.Add(line.Split('\t'));
            return found;
        }
    }
}

}
