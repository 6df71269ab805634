// A compensator of `elastic export c --prefix arm` for a control loop in C++, free of ROS.
#ifndef ELASTIC_CONTROLLER__COMPENSATION_HPP_
#define ELASTIC_CONTROLLER__COMPENSATION_HPP_

#include "elastic_controller/arm.h"

#include <array>
#include <cmath>
#include <cstddef>

namespace elastic_controller
{

/// Commands that bring the links to references; a bad reference keeps the last command.
class Compensation
{
public:
  static constexpr std::size_t size = ARM_JOINTS;
  using Values = std::array<double, size>;

  Compensation() {begin(Values{});}

  /// Begin anew where the servos stand: the offset grows from zero.
  /// @param held Angles that are commanded until the first good reference [rad].
  void begin(const Values & held)
  {
    arm_begin(&arm_);
    command_ = held;
  }

  /// Take the links' desired angles [rad]; false where one is nan or infinite.
  bool update(const Values & desired)
  {
    Values command{};
    if (arm_command(&arm_, desired.data(), nullptr, nullptr, command.data()) != ARM_OK) {
      return false;
    }
    command_ = command;
    return true;
  }

  /// Carry a point mass [kg] at a place in the frame of the last link [m].
  bool set_payload(double mass_kg, const std::array<double, 3> & at)
  {
    return arm_set_payload(&arm_, ARM_TIP, mass_kg, at.data()) == ARM_OK;
  }

  /// Where the links are at rest when the encoders show theta [rad]; false where a load tips one.
  bool link_angle(const Values & theta, Values & links) const
  {
    return arm_link_angle(&arm_, theta.data(), links.data()) == ARM_OK;
  }

  /// The last command of the servos [rad].
  const Values & command() const {return command_;}

private:
  arm_state arm_{};
  Values command_{};
};

}  // namespace elastic_controller

#endif  // ELASTIC_CONTROLLER__COMPENSATION_HPP_
