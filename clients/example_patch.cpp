// A patch of colour in the terminal, whose hue (degrees) and light (%) a hilbo session chooses.
//
//     hilbo init colour.toml --name colour --parameter hue=140:260:deg --parameter light=20:80:%
//     hilbo session colour.toml --participant P01 --dry-run      # in another terminal: prints the links
//     g++ -std=c++11 -pthread example_patch.cpp -o example_patch && ./example_patch LINK-OF-THE-STIMULUS
//
// The reference is a patch of a hidden colour.

#include <cmath>
#include <iostream>

#include "hilbo_stimulus.hpp"

// Red (0), green (8) or blue (4), of 255, of a colour whose saturation is 0.7.
static int part(double hue, double light, int which) {
  const double k = std::fmod(which + hue / 30, 12), room = 0.7 * std::min(light, 100 - light) / 100;
  return static_cast<int>(255 * (light / 100 - room * std::max(-1.0, std::min({k - 3, 9 - k, 1.0}))));
}

// A patch under a title; an empty screen without values.
static void draw(const std::string &title, const hilbo::Values &values) {
  std::cout << "\x1b[2J\x1b[H" << title << "\n";
  if (!values.empty()) {
    const double hue = values.at("hue"), light = values.at("light");
    for (int row = 0; row < 12; ++row)
      std::cout << "\x1b[48;2;" << part(hue, light, 0) << ";" << part(hue, light, 8) << ";" << part(hue, light, 4)
                << "m" << std::string(40, ' ') << "\x1b[0m\n";
  }
  std::cout << std::flush;
}

int main(int count, char **words) {
  if (count != 2) {
    std::cerr << "usage: example_patch LINK, the one that hilbo session prints for the stimulus\n";
    return 2;
  }
  const hilbo::Values reference = {{"hue", 205.0}, {"light", 45.0}};
  try {
    hilbo::Options options;
    options.neutral_within_s = 0.2;
    hilbo::Stimulus stimulus(words[1], "example_patch.cpp", "1", options);
    hilbo::Order order;
    while (stimulus.next(order)) {
      if (order.what != "present") {
        draw("", {});
        stimulus.neutral();
      } else if (order.show == "reference") {
        draw("Reference", reference);
        stimulus.presented();
      } else if (!order.values.count("hue") || !order.values.count("light")) {
        stimulus.failed("this patch has hue and light");
      } else {
        draw("Test", order.values);
        stimulus.presented(order.values); // the values really presented: here, the requested ones
      }
    }
  } catch (const hilbo::Error &error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
