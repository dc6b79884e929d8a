// A cube in a Unity scene, whose hue (degrees) and light (%) a hilbo session chooses.
//
//     hilbo init colour.toml --name colour --parameter hue=140:260:deg --parameter light=20:80:%
//     hilbo session colour.toml --participant P01 --dry-run      # prints the links
//
// Copy this file and HilboStimulus.cs into Assets, add this script to a cube, give it the link of the stimulus in the
// inspector, press Play. The next Play takes the same link, as soon as the last one is gone. An order is confirmed in the frame
// after the one that was drawn with it. Written without Unity, and never run in it.

using UnityEngine;

public class ExampleUnity : MonoBehaviour {
    public string link = "";

    Hilbo.Stimulus stimulus;
    Hilbo.Order drawn;  // to be confirmed in the next frame

    void Start() {
        stimulus = new Hilbo.Stimulus(link, "ExampleUnity", "1", neutralWithinS: 0.2, log: Debug.LogWarning);
    }

    void Update() {
        if (drawn != null) {
            if (drawn.What == "present") stimulus.Presented();
            else stimulus.Neutral();
            drawn = null;
        }
        Hilbo.Order order;
        if (!stimulus.Next(out order, 0)) return;
        var cube = GetComponent<Renderer>();
        cube.enabled = order.What == "present";
        if (cube.enabled) {
            var test = order.Show == "test";
            float hue = test ? (float)order.Values["hue"] : 205, light = test ? (float)order.Values["light"] : 45;
            cube.material.color = Color.HSVToRGB(hue / 360, 0.7f, light / 100);
        }
        drawn = order;
    }

    void OnDestroy() {
        if (stimulus != null) stimulus.Dispose();
    }
}
