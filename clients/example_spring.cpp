// A spring and a damper against a finger, whose stiffness (N/mm) and damping (N s/mm) a hilbo session chooses.
//
//     hilbo init spring.toml --parameter stiffness=0.1:2:N/mm --parameter damping=0.001:0.02:N.s/mm
//     hilbo doctor spring.toml --stimulus                        # prints a link: measures how fast this program stops
//     g++ -std=c++11 -pthread example_spring.cpp -o example_spring && ./example_spring LINK-OF-THE-STIMULUS
//
// The loop at 1 kHz stands for yours: it reads a position (here of a finger that is simulated), and sets a force (here
// none is set). What has to be the same in yours: go_neutral only sets an atomic number, the loop looks at it in each
// tick, and contact is reported as the loop detects it.

#include <atomic>
#include <cmath>
#include <csignal>
#include <iostream>

#include "hilbo_stimulus.hpp"

static std::atomic<bool> ended(false);

struct Spring {
  std::atomic<double> stiffness, damping; // both 0: no force at any position
  Spring() : stiffness(0), damping(0) {}
  void set(double k, double b) {
    stiffness = k;
    damping = b;
  }
};

static double now() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

// A force in N: here for your motor's call.
static void set_motor(double) {}

// Until the program ends; on stderr when the spring comes and goes.
static void loop(Spring &spring, hilbo::Stimulus &stimulus) {
  bool touched = false, pushed = false;
  for (long tick = 0; !ended; ++tick) {
    const double phase = 6.283185307 * static_cast<double>(tick % 600) / 600;      // a finger that comes every 0.6 s
    const double x = 4 * std::sin(phase) - 2, v = 4 * std::cos(phase) * 6.283185307 / 0.6; // mm, mm/s
    const double k = spring.stiffness, b = spring.damping;
    set_motor(x > 0 ? k * x + b * v : 0);
    if ((x > 0) != touched) stimulus.contact(touched = x > 0);
    if ((k > 0) != pushed) {
      pushed = k > 0;
      std::fprintf(stderr, "%.3f %s\n", now(), pushed ? "force" : "neutral");
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
}

int main(int count, char **words) {
  if (count != 2) {
    std::cerr << "usage: example_spring LINK, the one that hilbo session prints for the stimulus\n";
    return 2;
  }
  std::signal(SIGINT, [](int) { ended = true; });
  Spring spring;
  hilbo::Options options;
  options.force = true;
  options.go_neutral = [&spring] { spring.set(0, 0); };
  options.neutral_within_s = 0.05;
  try {
    hilbo::Stimulus stimulus(words[1], "example_spring.cpp", "1", options);
    std::thread looping([&] { loop(spring, stimulus); });
    try {
      hilbo::Order order;
      while (!ended) {
        if (!stimulus.next(order, 0.1)) continue;
        if (order.what != "present") {
          spring.set(0, 0);
          stimulus.neutral();
        } else {
          const bool test = order.show == "test";
          spring.set(test ? order.values.at("stiffness") : 0.8, test ? order.values.at("damping") : 0.005);
          stimulus.presented();
        }
      }
    } catch (const std::exception &error) {
      std::cerr << error.what() << "\n";
    }
    ended = true;
    spring.set(0, 0);
    looping.join();
  } catch (const std::exception &error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
