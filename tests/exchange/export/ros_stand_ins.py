"""What a node of ROS 2 takes from rclcpp or rclpy, and no more: a clock that is set, and events that are listed."""

import subprocess
import sys
from types import ModuleType, SimpleNamespace

HEADERS = {
    "sensor_msgs/msg/joint_state.hpp": """#pragma once
#include <string>
#include <vector>
namespace sensor_msgs::msg {
struct JointState { std::vector<std::string> name; std::vector<double> position, velocity, effort; };
}
""",
    "std_msgs/msg/float64_multi_array.hpp": """#pragma once
#include <vector>
namespace std_msgs::msg { struct Float64MultiArray { std::vector<double> data; }; }
""",
    "rclcpp/rclcpp.hpp": r"""#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>
#include <sensor_msgs/msg/joint_state.hpp>
#define RCLCPP_ERROR(logger, ...) (std::fprintf(stderr, __VA_ARGS__), std::fprintf(stderr, "%s\n", (logger).end))
namespace rclcpp {
struct Logger { const char *end; };
struct Duration {
  std::int64_t ns;
  double seconds() const { return 1e-9 * double(ns); }
  static Duration from_seconds(double s) { return {std::llround(1e9 * s)}; }
};
struct Time { std::int64_t ns; Duration operator-(Time other) const { return {ns - other.ns}; } };
struct Clock { using SharedPtr = std::shared_ptr<Clock>; Time time{0}; Time now() const { return time; } };
struct TimerBase { using SharedPtr = std::shared_ptr<TimerBase>; };
struct SensorDataQoS {};
template<class M> struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
template<class M> struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  Clock::SharedPtr clock;
  void publish(const M & message) {
    std::printf("%lld", static_cast<long long>(clock->time.ns));
    for (double u : message.data) std::printf(" %.17g", u);
    std::printf("\n");
  }
};
struct Node {
  explicit Node(const std::string &) {}
  template<class M> auto create_publisher(const std::string &, int) {
    return std::make_shared<Publisher<M>>(Publisher<M>{clock});
  }
  template<class M, class F> auto create_subscription(const std::string &, SensorDataQoS, F f) {
    read = f;
    return std::make_shared<Subscription<M>>();
  }
  Clock::SharedPtr get_clock() { return clock; }
  Logger get_logger() { return {""}; }
  Clock::SharedPtr clock = std::make_shared<Clock>();
  std::function<void(const sensor_msgs::msg::JointState &)> read;
  std::function<void()> tick;
};
template<class F> TimerBase::SharedPtr create_timer(Node * node, Clock::SharedPtr, Duration period, F f) {
  node->tick = f;
  std::printf("%lld\n", static_cast<long long>(period.ns));
  return std::make_shared<TimerBase>();
}
inline void init(int, char **) {}
inline void shutdown() {}
inline void spin(std::shared_ptr<Node> node) {  // what happens, one event on a line: when, and names, positions, …
  for (std::string line, field; std::getline(std::cin, line);) {
    std::istringstream fields(line);
    fields >> node->clock->time.ns;
    sensor_msgs::msg::JointState state;
    std::size_t kind = 0;
    for (; fields >> field; ) {
      if (field == ";") kind++;
      else if (kind == 0) state.name.push_back(field);
      else (kind == 1 ? state.position : state.velocity).push_back(std::stod(field));
    }
    if (kind) node->read(state); else node->tick();
  }
}
}
""",
}


def in_cpp(program, events):
    """(Δt in ns, what was published when, log) of the C++ node; an event is (ns,) of the timer, or (ns, state)."""
    lines = [f"{ns} " + " ; ".join(" ".join(map(str, field)) for field in fields) for ns, *fields in events]
    done = subprocess.run([program], input="\n".join(lines) + "\n", capture_output=True, text=True, check=True)
    (period,), *published = [[float(field) for field in line.split()] for line in done.stdout.splitlines()]
    return period, published, done.stderr.splitlines()


class Node:
    """rclpy.node.Node."""

    made: "Node"

    def __init__(self, name):
        Node.made, self.ns, self.published, self.log = self, 0, [], []

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.published.append([self.ns, *message.data]))

    def create_subscription(self, kind, topic, callback, qos):
        self.callback = callback

    def create_timer(self, seconds, callback):
        self.period, self.tick = 1e9 * seconds, callback

    def get_clock(self):
        return SimpleNamespace(now=lambda: Instant(self.ns))

    def get_logger(self):
        return SimpleNamespace(error=self.log.append)


class Instant:
    """rclpy.time.Time, and the Duration between two."""

    def __init__(self, nanoseconds):
        self.nanoseconds = nanoseconds

    def __sub__(self, other):
        return Instant(self.nanoseconds - other.nanoseconds)


def in_python(monkeypatch, source, events):
    """The same of the Python node."""

    def spin(node):
        for node.ns, *state in events:
            if state:
                node.callback(SimpleNamespace(**dict(zip(("name", "position", "velocity"), state, strict=True))))
            else:
                node.tick()

    messages = {"JointState": SimpleNamespace, "Float64MultiArray": SimpleNamespace}
    modules = {
        "rclpy": {"init": lambda: None, "spin": spin},
        "rclpy.executors": {"ExternalShutdownException": type("ExternalShutdownException", (Exception,), {})},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "sensor_msgs": {}, "sensor_msgs.msg": messages, "std_msgs": {}, "std_msgs.msg": messages,
    }  # fmt: skip
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    exec(compile(source, "policy_node.py", "exec"), {"__name__": "__main__"})
    return Node.made.period, Node.made.published, Node.made.log
