// SPDX-License-Identifier: Apache-2.0
//
// What a control loop may take from a TactileContacts. No ROS but the message itself.

#pragma once

#include <cmath>
#include <optional>
#include <string>

#include <tactile_cdma/msg/tactile_contacts.hpp>

namespace tactile_cdma_example
{

// The force against the skin, N, 0 or more, where it is known for certain; else why it is not.
struct Touch
{
  std::optional<double> force_n;
  std::string why;
};

// age_s: time since the header's stamp. A force that is not known is never 0: whoever pushes on
// because nothing is felt, pushes blindly.
inline Touch judge(
  const tactile_cdma::msg::TactileContacts & message, double age_s, double stale_after_s)
{
  if (!(age_s <= stale_after_s) || age_s < -stale_after_s) {
    return {std::nullopt, "old"};
  }
  if (!message.touched && !message.untouched) {
    return {std::nullopt, "blind"};
  }
  if (message.taxels_valid < message.taxels_in_service) {
    return {std::nullopt, "blind in part: the force is a lower bound"};
  }
  double force_n = 0.0;
  for (const auto & contact : message.contacts) {
    force_n -= contact.force.x * contact.normal.x + contact.force.y * contact.normal.y +
      contact.force.z * contact.normal.z;
    if (contact.lower_bound) {
      return {std::nullopt, "beyond the sensors' range: the force is a lower bound"};
    }
  }
  if (!std::isfinite(force_n)) {
    return {std::nullopt, "not a number"};
  }
  return {force_n, ""};
}

// One step of an admittance: how fast to move against what is touched, m/s, so that the force comes
// to wanted_n. Without a force it stops, which a gripper or an arm can do at any time.
inline double velocity(const Touch & touch, double wanted_n, double damping_ns_m, double most_m_s)
{
  if (!touch.force_n) {
    return 0.0;
  }
  const double wanted_m_s = (wanted_n - *touch.force_n) / damping_ns_m;
  return std::fmax(-most_m_s, std::fmin(wanted_m_s, most_m_s));
}

}  // namespace tactile_cdma_example
