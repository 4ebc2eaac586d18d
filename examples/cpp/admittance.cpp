// SPDX-License-Identifier: Apache-2.0
//
// An admittance loop as a node of rclcpp: at every message of /skin/contacts, and every 10 ms, it
// publishes how fast to move against what is touched, on /admittance/velocity (m/s).
//
//     colcon build --packages-select tactile_cdma_cpp_example
//     ros2 run tactile_cdma_cpp_example admittance

#include <chrono>
#include <memory>

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/float64.hpp>

#include "touch.hpp"

namespace
{

using tactile_cdma::msg::TactileContacts;

constexpr double STALE_AFTER_S = 0.1;  // eight frames
constexpr double WANTED_N = 2.0, DAMPING_NS_M = 200.0, MOST_M_S = 0.02;

class Admittance : public rclcpp::Node
{
public:
  Admittance()
  : Node("admittance")
  {
    velocity_ = create_publisher<std_msgs::msg::Float64>("/admittance/velocity", 1);
    contacts_ = create_subscription<TactileContacts>(
      "/skin/contacts", rclcpp::QoS(2).best_effort(),
      [this](TactileContacts::ConstSharedPtr message) {
        latest_ = message;
        step();
      });
    timer_ = create_wall_timer(std::chrono::milliseconds(10), [this]() {step();});
  }

private:
  void step()
  {
    tactile_cdma_example::Touch touch{std::nullopt, "nothing came"};
    if (latest_) {
      const double age_s = (now() - latest_->header.stamp).seconds();
      touch = tactile_cdma_example::judge(*latest_, age_s, STALE_AFTER_S);
    }
    std_msgs::msg::Float64 command;
    command.data = tactile_cdma_example::velocity(touch, WANTED_N, DAMPING_NS_M, MOST_M_S);
    velocity_->publish(command);
    if (!touch.force_n) {
      RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 1000, "stopped: %s", touch.why.c_str());
    }
  }

  TactileContacts::ConstSharedPtr latest_;
  rclcpp::Publisher<std_msgs::msg::Float64>::SharedPtr velocity_;
  rclcpp::Subscription<TactileContacts>::SharedPtr contacts_;
  rclcpp::TimerBase::SharedPtr timer_;
};

}  // namespace

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Admittance>());
  rclcpp::shutdown();
  return 0;
}
