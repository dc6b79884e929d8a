// A viscoelastic material that this program renders itself at 1 kHz, with the safety chain of hilbo's device, and whose
// K1, B1 and alpha a hilbo session chooses. docs/device/host-port.md has what a real device needs.
//
//     make -C firmware host
//     B=build/firmware/gcc
//     g++ -pthread -Ifirmware/port/library clients/example_renderer.cpp $B/libhilbo_renderer.so -o example_renderer
//     hilbo init material.toml --parameter K1=0.2:0.6:N/mm --parameter B1=0.2:0.6:N.s^alpha/mm --parameter alpha=0.1:0.5:1
//     hilbo doctor material.toml --stimulus                      # prints a link: measures how fast this program stops
//     build/firmware/gcc/hilbo-motor /dev/shm/motor all &        # a simulated device, in place of yours
//     ./example_renderer /dev/shm/motor LINK-OF-THE-STIMULUS
//
// Two threads: one reads a position, ticks and outputs a force, once a millisecond and nothing else; the other takes the
// session's orders. What has to be the same in yours: all of it but the three lines that touch hilbo_motor, and numbers
// that were measured.

#include <atomic>
#include <chrono>
#include <csignal>
#include <iostream>

#include "hilbo_motor.h"
#include "hilbo_realtime.h"
#include "hilbo_renderer.h"
#include "hilbo_stimulus.hpp"

typedef std::chrono::steady_clock Clock;

static const double K_eff = 0.1;                        // N/mm, static stiffness of every set: K0 follows from it
static const double reference[3] = {0.4, 0.4, 0.3};     // K1, B1, alpha
static std::atomic<bool> ended(false);

static hilbo_device_numbers simulated() {
  hilbo_device_numbers numbers = hilbo_device_numbers();
  numbers.size = sizeof numbers;
  numbers.simulated = 1;
  numbers.tick_rate_Hz = 1000;
  numbers.latency_us = 50;
  numbers.delay_us = 1000;
  numbers.watchdog_ticks = 250;
  numbers.hold_ticks = 10;
  numbers.damping_N_s_per_m = 0.95;
  numbers.force_limit_N = numbers.continuous_force_N = 20.0;
  numbers.heating_s = 10.0;
  numbers.position_low_mm = -5.1;
  numbers.position_high_mm = 20.1;
  numbers.position_step_mm = 0.001;
  numbers.slew_limit_N_per_s = 500.0;
  numbers.velocity_limit_mm_per_s = 1000.0;
  numbers.plausible_step_mm = 2.0;
  numbers.K0_N_per_mm = {-64.0, 64.0};
  numbers.K1_N_per_mm = {1e-3, 64.0};
  numbers.B1_N_s_alpha_per_mm = {1e-4, 64.0};
  numbers.alpha = {0.005, 0.995};
  return numbers;
}

static double now() { return std::chrono::duration<double>(Clock::now().time_since_epoch()).count(); }

// A tick that comes too late is a HOLD: this thread goes before all others.
static void loop(hilbo_renderer *renderer, hilbo_motor *motor) {
  if (!hilbo_realtime()) std::cerr << "There is no real-time priority for this user; ticks may come late.\n";
  for (Clock::time_point due = Clock::now(); !ended; due += std::chrono::milliseconds(1)) {
    std::this_thread::sleep_until(due);
    if (Clock::now() - due > std::chrono::milliseconds(20)) due = Clock::now(); // it was stopped: do not catch up
    const double time_s = now();
    const double position_mm = hilbo_motor_get(&motor->position_mm);
    const double velocity_mm_per_s = hilbo_motor_get(&motor->velocity_mm_per_s);
    hilbo_motor_command(motor, hilbo_tick(renderer, position_mm, velocity_mm_per_s, time_s));
  }
}

// The orders of a session, carried out by a renderer that another thread ticks.
class Rendering {
public:
  Rendering(hilbo_renderer *renderer, hilbo::Stimulus &stimulus) : renderer_(renderer), stimulus_(stimulus) {}

  void run() {
    hilbo::Order order;
    while (!ended) {
      const bool is_new = stimulus_.next(order, 0.01);
      look();
      const bool holds = state_.state == HILBO_HOLD || state_.state == HILBO_ESTOP;
      if (presents_ && holds) { // in the middle of a trial
        presents_ = false;
        stimulus_.begin_again(hilbo_cause_in_words(state_.cause));
      } else if (is_new && order.what == "present") {
        present(order);
      } else if (is_new) {
        rest();
      }
    }
    hilbo_stop(renderer_);
  }

private:
  // Every few milliseconds, whatever is waited for: the heartbeat, and what the session has to know.
  void look() {
    hilbo_heartbeat(renderer_);
    hilbo_get_state(renderer_, &state_);
    stimulus_.contact(state_.contact != 0);
  }

  // Whether it is the case within so many seconds.
  template <typename Condition> bool wait(double seconds, Condition is_so) {
    const double end = now() + seconds;
    for (look(); !is_so(); look()) {
      if (now() > end || ended) return false;
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    return true;
  }

  std::string sentence() {
    char text[256];
    hilbo_sentence(renderer_, text, sizeof text);
    return text;
  }

  void present(const hilbo::Order &order) {
    const bool test = order.show == "test";
    hilbo_parameters set = hilbo_parameters();
    set.K1_N_per_mm = test ? order.values.at("K1") : reference[0];
    set.B1_N_s_alpha_per_mm = test ? order.values.at("B1") : reference[1];
    set.alpha = test ? order.values.at("alpha") : reference[2];
    set.force_limit_N = 15.0;
    set.taps = 101;
    set.K0_N_per_mm = hilbo_K0_of(&set, 1000, K_eff);
    const std::string why = put_in_force(set, order.within_s - 0.1);
    if (why.empty()) {
      presents_ = true;
      stimulus_.presented();
    } else {
      hilbo_stop(renderer_);
      stimulus_.failed(why);
    }
  }

  // "" when it is rendered, or why it is not.
  std::string put_in_force(const hilbo_parameters &set, double seconds) {
    presents_ = false;
    if (!at_rest()) return hilbo_cause_in_words(state_.cause);
    if (hilbo_set(renderer_, &set) != 0) return sentence();
    const bool decided = wait(seconds, [this] { return state_.set != HILBO_WAITING && state_.contact == 0; });
    if (state_.set == HILBO_REFUSED) return sentence();
    if (!decided) return "The handle is in the material.";
    return hilbo_start(renderer_, state_.stops) == 0 ? "" : sentence();
  }

  // STOPPED, and what held is cleared: the trial that it held in is void by now.
  bool at_rest() {
    hilbo_stop(renderer_);
    return wait(0.2, [this] {
      if (state_.state == HILBO_HOLD || state_.state == HILBO_ESTOP) hilbo_clear(renderer_, state_.stops);
      return state_.state == HILBO_STOPPED;
    });
  }

  void rest() {
    presents_ = false;
    if (at_rest()) stimulus_.neutral();
  }

  hilbo_renderer *renderer_;
  hilbo::Stimulus &stimulus_;
  hilbo_state state_ = hilbo_state();
  bool presents_ = false;
};

int main(int count, char **words) {
  if (count != 3) {
    std::cerr << "usage: example_renderer MOTOR LINK: the file of hilbo-motor, the link of the stimulus\n";
    return 2;
  }
  std::signal(SIGINT, [](int) { ended = true; });
  const char *why = "";
  const hilbo_device_numbers numbers = simulated();
  hilbo_motor *motor = hilbo_motor_open(words[1], 0);
  hilbo_renderer *renderer = hilbo_open(&numbers, &why);
  if (motor == nullptr || renderer == nullptr) {
    std::cerr << (motor == nullptr ? "There is no motor behind this file; start hilbo-motor." : why) << "\n";
    return 1;
  }
  std::thread looping(loop, renderer, motor);
  hilbo::Options options;
  options.force = true;
  options.go_neutral = [renderer] { hilbo_stop(renderer); };
  options.neutral_within_s = 0.05;
  int status = 0;
  try {
    hilbo::Stimulus stimulus(words[2], "example_renderer.cpp", "1", options);
    Rendering(renderer, stimulus).run();
  } catch (const std::exception &error) {
    std::cerr << error.what() << "\n";
    status = 1;
  }
  hilbo_stop(renderer);
  std::this_thread::sleep_for(std::chrono::milliseconds(50)); // the loop takes the force down
  ended = true;
  looping.join();
  hilbo_close(renderer);
  return status;
}
