#ifndef ELASTIC_CONTROLLER__ELASTIC_CONTROLLER_HPP_
#define ELASTIC_CONTROLLER__ELASTIC_CONTROLLER_HPP_

#include <string>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "elastic_controller/compensation.hpp"

namespace elastic_controller
{

/// Takes positions of the links from another controller, and commands positions of the servos.
class ElasticController : public controller_interface::ChainableControllerInterface
{
public:
  controller_interface::CallbackReturn on_init() override;

  controller_interface::InterfaceConfiguration command_interface_configuration() const override;

  controller_interface::InterfaceConfiguration state_interface_configuration() const override;

  controller_interface::CallbackReturn on_configure(
    const rclcpp_lifecycle::State & previous_state) override;

  controller_interface::CallbackReturn on_activate(
    const rclcpp_lifecycle::State & previous_state) override;

protected:
  std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() override;

  bool on_set_chained_mode(bool chained_mode) override;

  controller_interface::return_type update_reference_from_subscribers(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

  controller_interface::return_type update_and_write_commands(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

private:
  controller_interface::InterfaceConfiguration positions() const;

  std::vector<std::string> joints_;
  Compensation compensation_;
};

}  // namespace elastic_controller

#endif  // ELASTIC_CONTROLLER__ELASTIC_CONTROLLER_HPP_
