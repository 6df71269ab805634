#include "elastic_controller/elastic_controller.hpp"

#include <limits>

#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "pluginlib/class_list_macros.hpp"

namespace elastic_controller
{

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::return_type;

namespace
{
constexpr double NO_REFERENCE = std::numeric_limits<double>::quiet_NaN();
}

CallbackReturn ElasticController::on_init()
{
  auto_declare<std::vector<std::string>>("joints", std::vector<std::string>());
  return CallbackReturn::SUCCESS;
}

InterfaceConfiguration ElasticController::positions() const
{
  InterfaceConfiguration found;
  found.type = controller_interface::interface_configuration_type::INDIVIDUAL;
  for (const auto & joint : joints_) {
    found.names.push_back(joint + "/" + hardware_interface::HW_IF_POSITION);
  }
  return found;
}

InterfaceConfiguration ElasticController::command_interface_configuration() const
{
  return positions();
}

InterfaceConfiguration ElasticController::state_interface_configuration() const
{
  return positions();
}

CallbackReturn ElasticController::on_configure(const rclcpp_lifecycle::State &)
{
  joints_ = get_node()->get_parameter("joints").as_string_array();
  if (joints_.size() != Compensation::size) {
    RCLCPP_ERROR(
      get_node()->get_logger(), "joints must name the %zu joints of arm.h in its order, got %zu",
      Compensation::size, joints_.size());
    return CallbackReturn::ERROR;
  }
  reference_interfaces_.assign(Compensation::size, NO_REFERENCE);
  return CallbackReturn::SUCCESS;
}

CallbackReturn ElasticController::on_activate(const rclcpp_lifecycle::State &)
{
  Compensation::Values stands{};
  for (std::size_t i = 0; i < stands.size(); i++) {
    stands[i] = state_interfaces_[i].get_value();
    if (!std::isfinite(stands[i])) {
      RCLCPP_ERROR(
        get_node()->get_logger(), "joint %s shows no position, so nothing can be held",
        joints_[i].c_str());
      return CallbackReturn::ERROR;
    }
  }
  compensation_.begin(stands);
  reference_interfaces_.assign(Compensation::size, NO_REFERENCE);
  return CallbackReturn::SUCCESS;
}

std::vector<hardware_interface::CommandInterface>
ElasticController::on_export_reference_interfaces()
{
  std::vector<hardware_interface::CommandInterface> found;
  for (std::size_t i = 0; i < joints_.size(); i++) {
    found.emplace_back(
      get_node()->get_name(), joints_[i] + "/" + hardware_interface::HW_IF_POSITION,
      &reference_interfaces_[i]);
  }
  return found;
}

bool ElasticController::on_set_chained_mode(bool)
{
  return true;
}

return_type ElasticController::update_reference_from_subscribers(
  const rclcpp::Time &, const rclcpp::Duration &)
{
  return return_type::OK;  // references come from another controller only
}

return_type ElasticController::update_and_write_commands(
  const rclcpp::Time &, const rclcpp::Duration &)
{
  Compensation::Values desired{};
  for (std::size_t i = 0; i < desired.size(); i++) {
    desired[i] = reference_interfaces_[i];
  }
  compensation_.update(desired);  // a reference that is none keeps the last command
  for (std::size_t i = 0; i < desired.size(); i++) {
    (void)command_interfaces_[i].set_value(compensation_.command()[i]);
  }
  return return_type::OK;
}

}  // namespace elastic_controller

PLUGINLIB_EXPORT_CLASS(
  elastic_controller::ElasticController, controller_interface::ChainableControllerInterface)
