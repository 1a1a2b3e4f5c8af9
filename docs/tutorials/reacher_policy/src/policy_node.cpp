#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <string>

#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "policy.h"

using sensor_msgs::msg::JointState;
using std_msgs::msg::Float64MultiArray;

namespace
{
constexpr std::array<const char *, 2> joints = {"shoulder", "elbow"};  // x: their positions, then their velocities
constexpr double dt = 0.01;  // s, of the task
constexpr double oldest = 5 * dt;  // s, that the latest state may be old

static_assert(LYAPNET_STATES == 2 * joints.size() && LYAPNET_CONTROLS == joints.size(), "the law of another task");
}  // namespace

class PolicyNode : public rclcpp::Node
{
public:
  PolicyNode() : Node("policy_node")
  {
    publisher_ = create_publisher<Float64MultiArray>("effort_controller/commands", 1);
    subscription_ = create_subscription<JointState>(
      "joint_states", rclcpp::SensorDataQoS(), [this](const JointState & message) { read(message); });
    timer_ = rclcpp::create_timer(this, get_clock(), rclcpp::Duration::from_seconds(dt), [this]() { step(); });
  }

private:
  void read(const JointState & message)
  {
    if (stopped_) return;
    const std::size_t size = message.name.size();
    if (message.position.size() != size || message.velocity.size() != size) {
      return stop("a position and a velocity for each name are needed");
    }
    for (std::size_t i = 0; i < joints.size(); i++) {
      const auto found = std::find(message.name.begin(), message.name.end(), joints[i]);
      if (found == message.name.end()) return stop(std::string("there is no joint ") + joints[i]);
      const auto at = static_cast<std::size_t>(found - message.name.begin());
      x_[i] = message.position[at];
      x_[joints.size() + i] = message.velocity[at];
    }
    if (!std::all_of(x_.begin(), x_.end(), [](double x) { return std::isfinite(x); })) {
      return stop("the state is not finite");
    }
    latest_ = get_clock()->now();
    if (!first_) first_ = latest_;
  }

  void step()
  {
    if (!first_ && !stopped_) return;  // no state yet
    const rclcpp::Time now = get_clock()->now();
    if (!stopped_ && (now - *latest_).seconds() > oldest) stop("the state is too old");
    Float64MultiArray u;
    u.data.assign(LYAPNET_CONTROLS, 0.0);
    if (!stopped_) lyapnet_control((now - *first_).seconds(), x_.data(), u.data.data());
    publisher_->publish(u);
  }

  void stop(const std::string & reason)
  {
    stopped_ = true;
    RCLCPP_ERROR(get_logger(), "stopped, zeros from here on: %s", reason.c_str());
  }

  std::array<double, LYAPNET_STATES> x_{};
  std::optional<rclcpp::Time> first_, latest_;
  bool stopped_ = false;
  rclcpp::Publisher<Float64MultiArray>::SharedPtr publisher_;
  rclcpp::Subscription<JointState>::SharedPtr subscription_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<PolicyNode>());
  rclcpp::shutdown();
  return 0;
}
