// A node's images and anchors in Unity or plain .NET, through `sags bridge web`; docs/bridges.md says what comes.
//
// Unity: put this file into Assets, and SagsView on a RawImage. Elsewhere: Program.cs.

using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using System.Linq;
using System.Net.WebSockets;
using System.Runtime.Serialization;
using System.Runtime.Serialization.Json;
using System.Threading;
using System.Threading.Tasks;

namespace Sags {

[DataContract] public sealed class Header { // what any message of the gateway may say
    [DataMember] public string topic, encoding, session, stale, error, units; // units: null, or "relative": lengths have none
    [DataMember] public long stamp_ns, epoch, id;
    [DataMember] public int[] shape, parts;
    [DataMember] public bool ok;
    [DataMember] public Clock result;
}

[DataContract] public sealed class Clock { [DataMember] public long received_ns, answered_ns; }

public struct Anchor { public uint Id; public float X, Y, Z, U, V, Visibility, Confidence, DepthConfidence; } // m in the world, px
// Show none as sure whose Confidence is below 0.5, nor its X, Y, Z where DepthConfidence is.

public sealed class Message {
    public Header Head;
    public byte[] Data; // the bulk: part 1
    public float FloatAt(int i) { return BitConverter.ToSingle(Data, 4 * i); }

    // Of `anchors`; columns are found by name, as new ones may come. Lost anchors (NaN) are left out.
    public List<Anchor> Anchors() {
        var names = Head.encoding.Split(',');
        var found = new List<Anchor>();
        for (int row = 0; row < Head.shape[0]; row++) {
            Func<string, int> at = name => row * names.Length + Array.IndexOf(names, name);
            Func<string, float> of = name => names.Contains(name) ? FloatAt(at(name)) : 0; // an older node does not send it: not sure
            if (float.IsNaN(of("x"))) continue;
            found.Add(new Anchor { Id = BitConverter.ToUInt32(Data, 4 * at("id")), X = of("x"), Y = of("y"), Z = of("z"),
                U = of("u"), V = of("v"), Visibility = of("visibility"), Confidence = of("confidence"), DepthConfidence = of("depth_confidence") });
        }
        return found;
    }
}

// Keeps the newest message of each topic, on a thread of its own.
public sealed class SagsClient : IDisposable {
    const int MaxHeader = 1 << 16, MaxMessage = 128 << 20;
    const double ClockEvery = 1000, ClockKnown = 5000; // ms
    readonly string url;
    readonly string[] topics;
    readonly double maxAge; // s
    byte[] buffer = new byte[1 << 20];
    readonly Dictionary<string, Message> newest = new Dictionary<string, Message>();
    readonly List<double> ahead = new List<double>(); // ms, the node's clock before ours at most: see docs/wire.md
    readonly CancellationTokenSource stop = new CancellationTokenSource();
    readonly Stopwatch watch = Stopwatch.StartNew(); // nobody sets it
    double Now { get { return watch.Elapsed.TotalMilliseconds; } }
    double asked = double.NegativeInfinity, answered = double.NegativeInfinity;
    bool waiting; // for an answer: `asked` is of that one
    double heard; // when the last bytes came
    volatile string problem = "not connected";

    public SagsClient(string url, double maxAge, params string[] topics) {
        this.url = url; this.topics = topics; this.maxAge = maxAge;
        Task.Run(() => Follow());
    }
    public void Dispose() { stop.Cancel(); }

    // The newest message of a topic if it may be shown as new; null, and why: draw nothing then.
    public Message Fresh(string topic, out string why) {
        lock (newest) {
            Message message;
            why = problem;
            if (!newest.TryGetValue(topic, out message)) return null;
            why = "the node's clock is not known";
            if (ahead.Count == 0 || Now - answered > ClockKnown) return null;
            double age = (Now + ahead.Min() - message.Head.stamp_ns * 1e-6) / 1000;
            why = "too old: " + age.ToString("0.00") + " s";
            return age <= maxAge ? message : null;
        }
    }

    async Task Follow() {
        while (!stop.IsCancellationRequested) {
            try {
                using (var socket = new ClientWebSocket()) {
                    await socket.ConnectAsync(new Uri(url), stop.Token);
                    waiting = false;
                    await Say(socket, "{\"subscribe\": [\"" + string.Join("\",\"", topics) + "\"]}");
                    heard = Now;
                    while (true) await Receive(socket);
                }
            } catch (Exception error) { // no gateway, or something that is none
                lock (newest) { newest.Clear(); ahead.Clear(); }
                problem = error.GetBaseException().Message;
                asked = double.NegativeInfinity;
            }
            await Task.Delay(500);
        }
    }

    Task Say(ClientWebSocket socket, string words) {
        return socket.SendAsync(new ArraySegment<byte>(System.Text.Encoding.UTF8.GetBytes(words)), WebSocketMessageType.Text, true, stop.Token);
    }

    async Task AskClock(ClientWebSocket socket) {
        if (Now - heard > ClockKnown) throw new IOException("the gateway is silent"); // not even its clock comes: connect anew
        if (waiting || Now - asked < ClockEvery) return;
        asked = Now;
        waiting = true;
        await Say(socket, "{\"id\": 1, \"op\": \"get_clock\"}");
    }

    async Task Receive(ClientWebSocket socket) {
        int length = 0;
        WebSocketReceiveResult got;
        do {
            if (length == buffer.Length) Array.Resize(ref buffer, 2 * length);
            var coming = socket.ReceiveAsync(new ArraySegment<byte>(buffer, length, buffer.Length - length), stop.Token);
            do await AskClock(socket); while (await Task.WhenAny(coming, Task.Delay(100)) != coming);
            got = await coming;
            heard = Now;
            length += got.Count;
            if (got.MessageType == WebSocketMessageType.Close || length > MaxMessage) throw new IOException("the connection was closed");
        } while (!got.EndOfMessage);
        bool binary = got.MessageType == WebSocketMessageType.Binary;
        int size = binary && length >= 4 ? BitConverter.ToInt32(buffer, 0) : length, from = binary ? 4 : 0;
        if (size < 0 || size > MaxHeader || from + size > length) throw new IOException("that is no gateway");
        var head = (Header)new DataContractJsonSerializer(typeof(Header)).ReadObject(new MemoryStream(buffer, from, size));
        if (head.id == 1) waiting = false;
        lock (newest) {
            if (binary) Keep(head, from + size, length);
            else if (head.topic != null) { newest.Remove(head.topic); problem = head.stale; }
            else if (head.ok && head.result != null) Learn(head.result);
            else problem = head.error;
        }
    }

    void Keep(Header head, int at, int length) {
        if (head.parts == null || head.parts.Length < 2 || head.shape == null || head.topic == null) return; // no bulk: not drawn here
        if (head.parts.Any(part => part < 0) || head.parts.Sum(part => (long)part) != length - at) throw new IOException("parts of other lengths");
        var data = new byte[head.parts[1]];
        Array.Copy(buffer, at + head.parts[0], data, 0, data.Length);
        long numbers = head.shape.Aggregate(1L, (product, side) => product * side);
        bool bytes = head.encoding != "32FC1" && !head.encoding.StartsWith("x,"); // else floats
        if (numbers * (bytes ? 1 : 4) == data.Length) newest[head.topic] = new Message { Head = head, Data = data };
    }

    void Learn(Clock said) {
        answered = Now;
        ahead.RemoveAll(most => most < said.answered_ns * 1e-6 - answered); // of before a clock was set
        ahead.Add(said.received_ns * 1e-6 - asked);
        if (ahead.Count > 8) ahead.RemoveAt(0);
    }
}

#if UNITY_5_3_OR_NEWER
// Shows a topic of rgba8 on a RawImage; it is off, so that what lies behind shows, while there is nothing new.
public sealed class SagsView : UnityEngine.MonoBehaviour {
    public string Url = "ws://127.0.0.1:8766/ws", Topic = "sags/left/render/image"; // any rgba8
    public List<Anchor> Anchors = new List<Anchor>(); // empty while they are not new
    SagsClient client;
    UnityEngine.Texture2D texture;
    Message shown;

    void OnEnable() { client = new SagsClient(Url, 0.4, Topic, "sags/anchors"); }
    void OnDisable() { client.Dispose(); }
    void Update() {
        string why;
        var image = GetComponent<UnityEngine.UI.RawImage>();
        var anchors = client.Fresh("sags/anchors", out why);
        Anchors = anchors == null ? new List<Anchor>() : anchors.Anchors();
        var message = client.Fresh(Topic, out why);
        image.enabled = message != null;
        if (message == null || message == shown) return;
        shown = message;
        int[] shape = message.Head.shape;
        if (texture == null || texture.width != shape[1] || texture.height != shape[0])
            texture = new UnityEngine.Texture2D(shape[1], shape[0], UnityEngine.TextureFormat.RGBA32, false);
        texture.LoadRawTextureData(message.Data);
        texture.Apply();
        image.texture = texture;
        image.uvRect = new UnityEngine.Rect(0, 1, 1, -1); // Unity's rows go up
    }
}
#endif
}
