// SPDX-License-Identifier: Apache-2.0
//
// Subscribes to /skin/contacts with rcl, which rclcpp and rclpy are made of, and prints for every
// message how fast an admittance would move. It needs no rclcpp: admittance.cpp is the same as a
// node of it.
//
//     cmake -S examples/cpp -B build/cpp && cmake --build build/cpp && build/cpp/subscribe

#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>

#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosidl_typesupport_cpp/message_type_support.hpp>

#include "touch.hpp"

namespace
{

using Contacts = tactile_cdma::msg::TactileContacts;

constexpr double STALE_AFTER_S = 0.1;  // eight frames
constexpr double WANTED_N = 2.0, DAMPING_NS_M = 200.0, MOST_M_S = 0.02;

volatile std::sig_atomic_t is_told_to_end = 0;

void check(rcl_ret_t result, const char * what)
{
  if (result != RCL_RET_OK) {
    std::fprintf(stderr, "subscribe: %s: %s\n", what, rcl_get_error_string().str);
    std::exit(1);
  }
}

double now_s()
{
  using std::chrono::duration, std::chrono::system_clock;
  return duration<double>(system_clock::now().time_since_epoch()).count();
}

void show(const Contacts & message)
{
  const auto & stamp = message.header.stamp;
  const double age_s = now_s() - (stamp.sec + stamp.nanosec * 1e-9);
  const auto touch = tactile_cdma_example::judge(message, age_s, STALE_AFTER_S);
  const double m_s = tactile_cdma_example::velocity(touch, WANTED_N, DAMPING_NS_M, MOST_M_S);
  const auto number = static_cast<unsigned long long>(message.sequence);
  if (touch.force_n) {
    std::printf("frame=%llu force_n=%.4f m_s=%.4f\n", number, *touch.force_n, m_s);
  } else {
    std::printf("frame=%llu unknown=%s m_s=%.4f\n", number, touch.why.c_str(), m_s);
  }
  std::fflush(stdout);
}

}  // namespace

int main(int argc, char ** argv)
{
  std::signal(SIGINT, [](int) {is_told_to_end = 1;});
  std::signal(SIGTERM, [](int) {is_told_to_end = 1;});

  rcl_init_options_t init = rcl_get_zero_initialized_init_options();
  check(rcl_init_options_init(&init, rcl_get_default_allocator()), "options");
  rcl_context_t context = rcl_get_zero_initialized_context();
  check(rcl_init(argc, argv, &init, &context), "init");
  rcl_node_t node = rcl_get_zero_initialized_node();
  const rcl_node_options_t node_options = rcl_node_get_default_options();
  check(rcl_node_init(&node, "subscribe", "", &context, &node_options), "node");

  // As whoever acts on contacts: the newest, not all, and a lost one holds up none after it.
  rcl_subscription_options_t options = rcl_subscription_get_default_options();
  options.qos.depth = 2;
  options.qos.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
  rcl_subscription_t contacts = rcl_get_zero_initialized_subscription();
  check(
    rcl_subscription_init(
      &contacts, &node, rosidl_typesupport_cpp::get_message_type_support_handle<Contacts>(),
      "/skin/contacts", &options),
    "subscription");

  rcl_wait_set_t wait_set = rcl_get_zero_initialized_wait_set();
  check(
    rcl_wait_set_init(
      &wait_set, 1, 0, 0, 0, 0, 0, &context, rcl_get_default_allocator()),
    "wait set");
  Contacts message;
  while (!is_told_to_end) {
    check(rcl_wait_set_clear(&wait_set), "wait set");
    check(rcl_wait_set_add_subscription(&wait_set, &contacts, nullptr), "wait set");
    const rcl_ret_t waited = rcl_wait(&wait_set, RCL_MS_TO_NS(100));
    if (waited == RCL_RET_TIMEOUT) {
      continue;  // a controller stops here: nothing has been felt for 0.1 s
    }
    check(waited, "wait");
    while (rcl_take(&contacts, &message, nullptr, nullptr) == RCL_RET_OK) {
      show(message);
    }
    rcl_reset_error();  // there was no more
  }

  check(rcl_wait_set_fini(&wait_set), "end");
  check(rcl_subscription_fini(&contacts, &node), "end");
  check(rcl_node_fini(&node), "end");
  check(rcl_shutdown(&context), "end");
  check(rcl_context_fini(&context), "end");
  check(rcl_init_options_fini(&init), "end");
  return 0;
}
