"""A patch of colour in the terminal, whose hue (degrees) and light (%) a hilbo session chooses.

    hilbo init colour.toml --name colour --parameter hue=140:260:deg --parameter light=20:80:%
    hilbo session colour.toml --participant P01 --dry-run      # in another terminal: prints the links
    python clients/example_patch.py LINK-OF-THE-STIMULUS

The reference is a patch of a hidden colour.
"""

import colorsys
import sys

from hilbo_stimulus import Stimulus, StimulusError

REFERENCE = {"hue": 205.0, "light": 45.0}
CLEAR, RESET = "\x1b[2J\x1b[H", "\x1b[0m"


def draw(title, values):
    """Clear the terminal and print a patch of colour under a title; only the title if there are no values."""
    lines = [title]
    if values:
        red, green, blue = colorsys.hls_to_rgb(values["hue"] / 360, values["light"] / 100, 0.7)
        colour = f"\x1b[48;2;{255 * red:.0f};{255 * green:.0f};{255 * blue:.0f}m"
        lines += [colour + 40 * " " + RESET] * 12
    print(CLEAR + "\n".join(lines), flush=True)


def main(link):
    """Present orders until Ctrl-C; ends the program for a study with other parameters."""
    with Stimulus(link, name="example_patch", version="1", neutral_within_s=0.2) as stimulus:
        for order in stimulus:
            names = {parameter["name"] for parameter in stimulus.parameters}
            if names != set(REFERENCE):
                raise SystemExit(f"This patch has {', '.join(REFERENCE)}; the study has {', '.join(sorted(names))}.")
            if order.do != "present":
                draw("", None)
                stimulus.neutral()
            elif order.show == "reference":
                draw("Reference", REFERENCE)
                stimulus.presented()
            else:
                draw("Test", order.values)
                stimulus.presented(order.values)  # the values really presented: here, the requested ones


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python example_patch.py LINK, the one that hilbo session prints for the stimulus")
    try:
        main(sys.argv[1])
    except StimulusError as error:
        raise SystemExit(str(error)) from None
    except KeyboardInterrupt:
        print(RESET)
