// Present the stimuli of a hilbo session from a C++ program.
//
// hilbo does not guard your actuators, and certifies nothing about them. If your program moves something that people
// touch, an independent hardware stop within reach of the hand must be provided by you.
//
// One file, for C++11 or newer, which needs nothing but the standard library and the system's sockets; copy it next to
// your program. Link with -pthread, on Windows with ws2_32.
//
//     #include "hilbo_stimulus.hpp"
//
//     hilbo::Stimulus stimulus(link, "my scene", "1.0");
//     hilbo::Order order;
//     while (stimulus.next(order)) {
//       if (order.what == "present") {
//         show(order.show, order.values);  // "test" with values, "reference" without
//         stimulus.presented();            // or presented({{"hue", 211.0}}): the values really presented
//       } else {
//         blank();
//         stimulus.neutral();
//       }
//     }
//
// A program that moves something sets Options::force and gives Options::go_neutral, a function that takes away all
// force. It is called by threads of this file, one at a time: as soon as the server orders it, when the connection
// fails, and at the latest 50 ms after the server has been silent for the time that it states (silence_s(), 1 s by
// default). Call contact(true) while a hand touches what you move: no order to present is handed to you
// until contact(false). docs/guides/stimulus.md of hilbo has the protocol.

#ifndef HILBO_STIMULUS_HPP
#define HILBO_STIMULUS_HPP

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <functional>
#include <limits>
#include <locale>
#include <map>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#ifdef _WIN32
#include <winsock2.h>
#include <ws2tcpip.h>
#else
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>
#endif

namespace hilbo {

typedef std::map<std::string, double> Values;        // parameter -> number, in the study's units; NaN for a level
typedef std::map<std::string, std::string> Texts;    // the same as it is sent: of a level its name
typedef std::vector<std::vector<std::string>> Lines; // an answer: lines of fields

// The session refuses this program, with the reason.
struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// What shall be the case from now on. what: "present", "neutral" (show nothing, push nothing) or "stop" (the same, at
// once). show: "test", with the values of its parameters, or "reference"; side: "a" or "b" where two tests are
// compared. It has to be confirmed within within_s.
struct Order {
  long long number = 0;
  std::string what = "neutral", show, side, trial;
  int step = 0;
  Values values;
  Texts texts;
  double within_s = 0;
};

// levels: the names of what has no order; the rest is of numbers.
struct Parameter {
  std::string name, unit;
  double low, high, tolerance;
  std::vector<std::string> levels;
};

struct Options {
  bool force = false;
  std::function<void()> go_neutral;
  double neutral_within_s = 1.0; // so soon is everything neutral after go_neutral was called, or after an order
  std::function<void(const std::string &)> log; // by default on stderr, with the time in s since 1970
};

namespace detail {

typedef std::chrono::steady_clock Clock;

inline double since(Clock::time_point then) { return std::chrono::duration<double>(Clock::now() - then).count(); }

inline std::string text(double value) {
  std::ostringstream out;
  out.imbue(std::locale::classic());
  out.precision(17);
  out << value;
  return out.str();
}

// NaN for what is no number.
inline double number(const std::string &word) {
  std::istringstream in(word);
  in.imbue(std::locale::classic());
  double value;
  return in >> value && in.peek() == EOF ? value : std::numeric_limits<double>::quiet_NaN();
}

inline std::string escaped(const std::string &text) {
  static const char digits[] = "0123456789ABCDEF";
  std::string out;
  for (unsigned char c : text) {
    if ((c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || std::strchr("-_.~", c)) {
      out += static_cast<char>(c);
    } else {
      out += {'%', digits[c / 16], digits[c % 16]};
    }
  }
  return out;
}

inline std::vector<std::string> split(const std::string &text, char mark) {
  std::vector<std::string> parts(1);
  for (char c : text) {
    if (c == mark) {
      parts.emplace_back();
    } else {
      parts.back() += c;
    }
  }
  return parts;
}

// The second field of the first line of that name, "" if there is none.
inline std::string field(const Lines &lines, const std::string &name) {
  for (const std::vector<std::string> &line : lines) {
    if (line.size() > 1 && line[0] == name) return line[1];
  }
  return "";
}

#ifdef _WIN32
typedef SOCKET Socket;
const Socket no_socket = INVALID_SOCKET;
inline void close_socket(Socket s) { closesocket(s); }
inline void start_sockets() {
  static const int started = [] { WSADATA data; return WSAStartup(MAKEWORD(2, 2), &data); }();
  (void)started;
}
inline void limit(Socket s, int what, double seconds) {
  DWORD ms = static_cast<DWORD>(1000 * seconds);
  setsockopt(s, SOL_SOCKET, what, reinterpret_cast<const char *>(&ms), sizeof ms);
}
#else
typedef int Socket;
const Socket no_socket = -1;
inline void close_socket(Socket s) { ::close(s); }
inline void start_sockets() {}
inline void limit(Socket s, int what, double seconds) {
  timeval time;
  time.tv_sec = static_cast<time_t>(seconds);
  time.tv_usec = static_cast<suseconds_t>(1e6 * (seconds - std::floor(seconds)));
  setsockopt(s, SOL_SOCKET, what, &time, sizeof time);
}
#endif
#ifdef MSG_NOSIGNAL
const int send_flags = MSG_NOSIGNAL;
#else
const int send_flags = 0;
#endif

// One connection to the server, made when it is needed, and again after a failure. Used by one thread at a time.
class Line {
public:
  Line(std::string host, std::string port) : host_(std::move(host)), port_(std::move(port)) {}
  ~Line() { close(); }
  Line(const Line &) = delete;
  Line &operator=(const Line &) = delete;

  // The answer to a form. Throws Error if there is none within so many seconds.
  Lines post(const std::string &path, const std::string &form, const std::string &key, double seconds) {
    try {
      const Clock::time_point end =
          Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
      if (socket_ == no_socket) connect(seconds);
      send("POST " + path + " HTTP/1.1\r\nHost: " + host_ + ":" + port_ +
           "\r\nContent-Type: application/x-www-form-urlencoded\r\n" +
           (key.empty() ? "" : "Authorization: Bearer " + key + "\r\n") +
           "Content-Length: " + std::to_string(form.size()) + "\r\n\r\n" + form);
      return answer(end);
    } catch (...) {
      close();
      throw;
    }
  }

  void close() {
    if (socket_ != no_socket) close_socket(socket_);
    socket_ = no_socket;
    unread_.clear();
  }

private:
  void connect(double seconds) {
    start_sockets();
    addrinfo hints, *found = nullptr;
    std::memset(&hints, 0, sizeof hints);
    hints.ai_family = AF_INET;
    hints.ai_socktype = SOCK_STREAM;
    if (getaddrinfo(host_.c_str(), port_.c_str(), &hints, &found) != 0) throw Error("there is no address " + host_);
    socket_ = ::socket(found->ai_family, found->ai_socktype, found->ai_protocol);
    bool done = false;
    if (socket_ != no_socket) {
      const int yes = 1;
      setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, reinterpret_cast<const char *>(&yes), sizeof yes);
#ifdef SO_NOSIGPIPE
      setsockopt(socket_, SOL_SOCKET, SO_NOSIGPIPE, &yes, sizeof yes);
#endif
      limit(socket_, SO_SNDTIMEO, seconds); // on Linux of connect, too
      done = ::connect(socket_, found->ai_addr, found->ai_addrlen) == 0;
    }
    freeaddrinfo(found);
    if (!done) throw Error("the server does not answer");
  }

  void send(const std::string &data) {
    for (size_t done = 0; done < data.size();) {
      const auto part = ::send(socket_, data.data() + done, data.size() - done, send_flags);
      if (part < 0 && interrupted()) continue;
      if (part <= 0) throw Error("the connection has failed");
      done += static_cast<size_t>(part);
    }
  }

  // A signal ended a call that has a time limit, as when the process was stopped and goes on.
  static bool interrupted() {
#ifdef _WIN32
    return false;
#else
    return errno == EINTR;
#endif
  }

  // More bytes, by a time.
  void receive(Clock::time_point end) {
    const double left = std::chrono::duration<double>(end - Clock::now()).count();
    if (left <= 0) throw Error("the server does not answer");
    limit(socket_, SO_RCVTIMEO, left + 0.001); // 0 would be for ever
    char part[4096];
    const auto got = ::recv(socket_, part, sizeof part, 0);
    if (got == 0) throw Error("the server has ended the connection");
    if (got < 0 && interrupted()) return; // and is called again
    if (got < 0) throw Error("the server does not answer");
    unread_.append(part, static_cast<size_t>(got));
  }

  Lines answer(Clock::time_point end) {
    size_t head;
    while ((head = unread_.find("\r\n\r\n")) == std::string::npos) receive(end);
    size_t length = 0;
    bool last = false;
    for (std::string line : split(unread_.substr(0, head), '\n')) {
      for (char &c : line) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c + 32) : c;
      if (line.compare(0, 15, "content-length:") == 0)
        length = static_cast<size_t>(number(split(line.substr(15), '\r')[0]));
      if (line.compare(0, 17, "connection: close") == 0) last = true;
    }
    while (unread_.size() < head + 4 + length) receive(end);
    Lines lines;
    for (const std::string &line : split(unread_.substr(head + 4, length), '\n')) lines.push_back(split(line, '\t'));
    unread_.erase(0, head + 4 + length);
    if (last) close();
    return lines;
  }

  const std::string host_, port_;
  Socket socket_ = no_socket;
  std::string unread_;
};

} // namespace detail

// This program's part in a session. link: the one that `hilbo session` prints for the stimulus, for one program at a
// time. Throws Error if the session does not let it in.
class Stimulus {
public:
  Stimulus(const std::string &link, const std::string &name, const std::string &version = "",
           Options options = Options())
      : options_(std::move(options)), own_(part(link, 0), part(link, 1)), talking_(part(link, 0), part(link, 1)) {
    if (options_.force && !options_.go_neutral)
      throw std::invalid_argument("A program with force gives go_neutral, which takes all force away.");
    hello_ = "name=" + detail::escaped(name) + "&version=" + detail::escaped(version) +
             "&force=" + (options_.force ? "true" : "false") +
             "&neutral_within_s=" + detail::text(options_.neutral_within_s);
    const Lines found = own_.post("/api/join", "bearer=true&token=" + detail::escaped(part(link, 2)), "", 10.0);
    if (detail::field(found, "role") != "stimulus") {
      const std::string why = detail::field(found, "error");
      throw Error(why.empty() ? "This link is not the one for the stimulus." : why);
    }
    key_ = detail::field(found, "key");
    talk_ = std::thread([this] { talk(); });
    watch_ = std::thread([this] { watch(); });
  }

  ~Stimulus() {
    close();
    talk_.join();
    watch_.join();
  }
  Stimulus(const Stimulus &) = delete;
  Stimulus &operator=(const Stimulus &) = delete;

  // The newest order that was not handed out yet, once there is one; false after timeout_s, or when it is closed.
  // Throws Error when this program is no longer part of the session.
  bool next(Order &order, double timeout_s = 1e9) {
    std::unique_lock<std::mutex> lock(mutex_);
    const auto may_go = [this] { return closed_ || !why_.empty() || due(); };
    changed_.wait_for(lock, std::chrono::duration<double>(timeout_s), may_go);
    if (!why_.empty()) throw Error(why_);
    if (closed_ || !due()) return false;
    order = handed_ = order_;
    handed_count_ = count_;
    return true;
  }

  // The newest order, for programs that look at every frame.
  Order order() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return order_;
  }

  // Whether a hand touches the moving part.
  void contact(bool yes) {
    std::lock_guard<std::mutex> lock(mutex_);
    contact_ = yes;
    changed_.notify_all();
  }

  // What the last order asked for is shown from now on, with the values that were asked for, or with these numbers and
  // levels. False if that is not taken: too late, too far off, another level; the trial is void then.
  bool presented() { return say("presented", handed().texts, ""); }
  bool presented(const Values &values, const Texts &levels = Texts()) {
    Texts texts = handed().texts;
    for (const auto &level : levels) texts[level.first] = level.second;
    for (const auto &value : values) {
      const auto asked = texts.find(value.first);
      if (std::isnan(value.second) && asked != texts.end() && std::isnan(detail::number(asked->second))) continue;
      if (!std::isfinite(value.second)) throw std::invalid_argument(value.first + " is no number.");
      texts[value.first] = detail::text(value.second);
    }
    return say("presented", texts, "");
  }

  // Nothing is shown, and nothing pushes, from now on.
  bool neutral() { return say("neutral", Texts(), ""); }

  // What the last order asked for cannot be shown; the trial is void.
  bool failed(const std::string &why) { return say("failed", Texts(), why.substr(0, 500)); }

  // Report that a device has stopped by itself: the trial is void, and this program registers again.
  void begin_again(const std::string &why) { lost(why); }

  // Go neutral, and leave.
  void close() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (closed_) return;
      closed_ = true;
      changed_.notify_all();
    }
    go_neutral();
  }

  // Of the study; after the first order was handed out.
  std::vector<Parameter> parameters() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return parameters_;
  }
  double silence_s() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return silence_s_;
  }

private:
  typedef detail::Clock Clock;

  // Host, port, and what stands behind #.
  static std::string part(const std::string &link, int which) {
    const size_t begin = link.compare(0, 7, "http://") == 0 ? 7 : std::string::npos;
    const size_t slash = link.find('/', 7), colon = link.rfind(':', slash), mark = link.find('#');
    if (begin == std::string::npos || slash == std::string::npos || colon < begin || mark == std::string::npos)
      throw Error("The link is not one that hilbo session has printed: http://…:…/#…");
    if (which == 0) return link.substr(begin, colon - begin);
    return which == 1 ? link.substr(colon + 1, slash - colon - 1) : link.substr(mark + 1);
  }

  bool due() const { return handed_count_ != count_ && !(options_.force && contact_ && order_.what == "present"); }

  Order handed() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return handed_;
  }

  // Says how things are, again and again, and keeps the newest order.
  void talk() {
    while (!over()) {
      try {
        if (run().empty()) {
          begin();
        } else {
          std::unique_lock<std::mutex> lock(mutex_);
          const Order order = order_;
          const std::string state = done_.first == order.number ? done_.second : "busy";
          const double wait = options_.force ? 0.05 : silence_s_ / 3;
          lock.unlock();
          report(talking_, order, state, Texts(), "&wait_s=" + detail::text(wait));
        }
      } catch (const std::exception &error) {
        lost(error.what());
        std::this_thread::sleep_for(std::chrono::milliseconds(200));
      }
    }
  }

  // Nobody waits longer for a server that says nothing than it stated.
  void watch() {
    while (!over()) {
      std::this_thread::sleep_for(std::chrono::duration<double>(std::min(0.05, silence_s() / 10)));
      std::unique_lock<std::mutex> lock(mutex_);
      const bool silent = !run_.empty() && detail::since(heard_) > silence_s_;
      lock.unlock();
      if (silent) lost("the server is silent");
    }
  }

  void begin() {
    const Lines found = talking_.post("/api/stimulus/hello", hello_ + again_, key_, silence_s());
    const std::string status = detail::field(found, "status");
    if (status == "400" || status == "401" || status == "403") {
      end(detail::field(found, "error"));
    } else if (status != "200") {
      throw Error("the session is not ready");
    } else {
      {
        std::lock_guard<std::mutex> lock(mutex_);
        parameters_.clear();
        for (const std::vector<std::string> &line : found) {
          if (line[0] == "parameter" && line.size() == 6)
            parameters_.push_back({line[1], line[5], detail::number(line[2]), detail::number(line[3]),
                                   detail::number(line[4]), {}});
          if (line[0] == "levels" && line.size() > 2)
            parameters_.push_back({line[1], "", 0, 0, 0, {line.begin() + 2, line.end()}});
        }
        silence_s_ = detail::number(detail::field(found, "silence_s"));
        run_ = detail::field(found, "run");
        heard_ = Clock::now();
      }
      again_ = "&run=" + detail::escaped(detail::field(found, "run"));
      take(detail::field(found, "run"), found);
    }
  }

  // A report from the program's own thread; whether it was taken.
  bool say(const std::string &state, const Texts &values, const std::string &why) {
    std::unique_lock<std::mutex> now(mutex_);
    const Order order = handed_;
    if (handed_count_ != count_) return false; // it is over; the next one is there already
    now.unlock();
    if (order.number == 0) return true; // there is no server to send it to
    try {
      std::lock_guard<std::mutex> lock(saying_);
      if (!report(own_, order, state, values, why.empty() ? "" : "&why=" + detail::escaped(why))) return false;
    } catch (const std::exception &error) {
      lost(error.what());
      return false;
    }
    std::lock_guard<std::mutex> lock(mutex_);
    done_ = std::make_pair(order.number, state);
    return true;
  }

  // Says how things are; whether that was taken.
  bool report(detail::Line &line, const Order &order, const std::string &state, const Texts &values,
              const std::string &more) {
    std::unique_lock<std::mutex> lock(mutex_);
    const std::string run = run_, contact = contact_ ? "true" : "false";
    const double seconds = silence_s_;
    lock.unlock();
    if (run.empty()) return false;
    std::string form = "run=" + run + "&order=" + std::to_string(order.number);
    form += "&state=" + state + "&contact=" + contact + more;
    if (state == "presented") form += "&trial=" + detail::escaped(order.trial);
    for (const auto &value : values)
      form += "&value." + detail::escaped(value.first) + "=" + detail::escaped(value.second);
    const Lines found = line.post("/api/stimulus", form, key_, seconds);
    const std::string status = detail::field(found, "status"), error = detail::field(found, "error");
    if (status != "200") log(error);
    if (status == "401" || status == "403") {
      end(error);
    } else if (!detail::field(found, "order").empty()) {
      take(run, found);
    } else if (status == "409") { // another server, or one that gave this program up
      lost(error);
    }
    return status == "200";
  }

  // A new order of the run that goes on; one that asks for it is neutral at once.
  void take(const std::string &run, const Lines &found) {
    Order order;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (run != run_) return; // it came after the silence
      heard_ = Clock::now();
      order = read(found);
      if (order.number <= order_.number) return;
      set(order);
    }
    if (order.what != "present" && options_.go_neutral && go_neutral()) {
      std::lock_guard<std::mutex> lock(mutex_);
      done_ = std::make_pair(order.number, "neutral");
    }
  }

  void set(const Order &order) {
    order_ = order;
    ++count_;
    changed_.notify_all();
  }

  static Order read(const Lines &found) {
    Order order;
    order.number = static_cast<long long>(detail::number(detail::field(found, "order")));
    order.what = detail::field(found, "do");
    order.show = detail::field(found, "show");
    order.side = detail::field(found, "side");
    order.trial = detail::field(found, "trial");
    if (order.what != "present") return order;
    order.step = static_cast<int>(detail::number(detail::field(found, "step")));
    order.within_s = detail::number(detail::field(found, "within_s"));
    for (const std::vector<std::string> &line : found) {
      if (line[0] == "value" && line.size() == 3) {
        order.texts[line[1]] = line[2];
        order.values[line[1]] = detail::number(line[2]);
      }
    }
    return order;
  }

  bool go_neutral() {
    std::lock_guard<std::mutex> lock(going_);
    try {
      if (options_.go_neutral) options_.go_neutral();
      return true;
    } catch (const std::exception &error) {
      log(std::string("go_neutral failed: ") + error.what());
      return false;
    }
  }

  // There is no server to be heard: neutral, and said to your program as an order.
  void lost(const std::string &why) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (run_.empty() || closed_) return;
      run_.clear();
      set(Order());
    }
    go_neutral();
    log("neutral: " + why);
  }

  void end(const std::string &why) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      why_ = why;
      changed_.notify_all();
    }
    go_neutral();
  }

  bool over() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return closed_ || !why_.empty();
  }

  std::string run() const {
    std::lock_guard<std::mutex> lock(mutex_);
    return run_;
  }

  void log(const std::string &words) const {
    if (options_.log) {
      options_.log(words);
    } else {
      const double now = std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
      std::fprintf(stderr, "%.3f hilbo_stimulus: %s\n", now, words.c_str());
    }
  }

  const Options options_;
  std::string key_, hello_;
  std::string again_;          // its own run, whose place it takes at once where the line broke
  detail::Line own_, talking_; // the program's connection, and that of the thread that talks
  mutable std::mutex mutex_;   // of all that follows
  std::condition_variable changed_;
  std::string run_, why_;
  Order order_, handed_;
  unsigned long long count_ = 0, handed_count_ = 0; // of orders: another run may give a number again
  std::pair<long long, std::string> done_; // the newest order that something was done about, and what
  std::vector<Parameter> parameters_;
  Clock::time_point heard_;
  double silence_s_ = 1.0;
  bool contact_ = false, closed_ = false;
  std::mutex saying_, going_;
  std::thread talk_, watch_;
};

} // namespace hilbo

#endif
