// @title@ as a controller of ros2_control. Made by fpirhc.
//
// State interfaces are the numbers of a sample after the time, command interfaces those of a command, in the order of layout.json. Their
// names are parameters; the defaults are made of the names of the plant. Settings are parameters that may be changed while it runs.
// update() allocates nothing and waits for nobody. The controller manager must run at the rate of the period.

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <mutex>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include <controller_interface/controller_interface.hpp>
#include <pluginlib/class_list_macros.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_lifecycle/state.hpp>

#include "@name@.h"

namespace @name@_ros {

using Return = controller_interface::CallbackReturn;

// Interfaces of ROS 2 Jazzy and later may be locked by another thread. A number that cannot be read is none, which is a bad sample.
template <class Interface>
auto read(const Interface& from, int) -> decltype(from.get_optional().value_or(0.0)) {
  return from.get_optional().value_or(std::numeric_limits<double>::quiet_NaN());
}
template <class Interface>
double read(const Interface& from, long) {
  return from.get_value();
}
template <class Interface>
bool written(Interface& to, double value) {
  if constexpr (std::is_void_v<decltype(to.set_value(value))>)
    return to.set_value(value), true;
  else
    return to.set_value(value);
}

class Controller : public controller_interface::ControllerInterface {
 public:
  Return on_init() override {
    auto_declare<std::vector<std::string>>("state_interfaces", {@states@});
    auto_declare<std::vector<std::string>>("command_interfaces", {@commands@});
@declared@    return Return::SUCCESS;
  }

  controller_interface::InterfaceConfiguration state_interface_configuration() const override { return named("state_interfaces"); }

  controller_interface::InterfaceConfiguration command_interface_configuration() const override { return named("command_interfaces"); }

  Return on_configure(const rclcpp_lifecycle::State&) override {
    const double rate = SECONDS_PER_UNIT * @NAME@_PERIOD * get_update_rate();
    if (std::abs(rate - 1) > 1e-6) return failed("the update rate must be one cycle per period");
    if (named("state_interfaces").names.size() != @NAME@_INPUTS - 1) return failed("state_interfaces: expected @given@ names");
    if (named("command_interfaces").names.size() != @NAME@_COMMANDS) return failed("command_interfaces: expected @sent@ names");
    @name@_init(&controller_);
#if @live@
    std::vector<rclcpp::Parameter> given;
    for (const auto path : PATHS) given.push_back(get_node()->get_parameter(std::string(path)));
    @name@_init(&wanted_);
    const auto answer = tuned(given);
    if (!answer.successful) return failed(answer.reason.c_str());
    tuning_ = get_node()->add_on_set_parameters_callback([this](const auto& given) { return tuned(given); });
#endif
    return Return::SUCCESS;
  }

  Return on_activate(const rclcpp_lifecycle::State&) override {
    @name@_reset(&controller_);
    begun_ = false;
    return Return::SUCCESS;
  }

  controller_interface::return_type update(const rclcpp::Time& time, const rclcpp::Duration&) override {
#if @live@
    if (changed_ && mutex_.try_lock()) {  // else in the next cycle
      controller_.settings = wanted_.settings;
      changed_ = false;
      mutex_.unlock();
    }
#endif
    @name@_inputs in;
    @name@_command out;
    casadi_real *sample = reinterpret_cast<casadi_real*>(&in), *command = reinterpret_cast<casadi_real*>(&out);
    if (!begun_) begin_ = time, begun_ = true;
    sample[0] = (time - begin_).seconds() / SECONDS_PER_UNIT;
    for (std::size_t k = 1; k < @NAME@_INPUTS; ++k) sample[k] = read(state_interfaces_[k - 1], 0);
    status_ = @name@_step(&controller_, &in, &out);
    bool sent = true;
    for (std::size_t k = 0; k < @NAME@_COMMANDS; ++k) sent = written(command_interfaces_[k], command[k]) && sent;
    return sent ? controller_interface::return_type::OK : controller_interface::return_type::ERROR;
  }

  @name@_status status() const { return status_; }

 private:
  static constexpr double SECONDS_PER_UNIT = @seconds@;  // of the period

  controller_interface::InterfaceConfiguration named(const char* parameter) const {
    return {controller_interface::interface_configuration_type::INDIVIDUAL, get_node()->get_parameter(parameter).as_string_array()};
  }

  Return failed(const char* why) const {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", why);
    return Return::ERROR;
  }

#if @live@
  // Called by the executor, beside update(): all are accepted, or none. Twice, since an interval may move beyond its old end.
  rcl_interfaces::msg::SetParametersResult tuned(const std::vector<rclcpp::Parameter>& given) {
    const std::lock_guard<std::mutex> lock(mutex_);
    const auto kept = wanted_.settings;
    rcl_interfaces::msg::SetParametersResult answer;
    for (int twice = 0; twice < 2; ++twice) {
      answer.successful = true;
      for (const auto& one : given) {
        const auto at = std::find(PATHS.begin(), PATHS.end(), one.get_name());
        if (at == PATHS.end() || @name@_set(&wanted_, @name@_setting(at - PATHS.begin()), one.as_double())) continue;
        answer.successful = false;
        answer.reason = one.get_name() + " is no number, or outside its bounds";
      }
    }
    if (!answer.successful) wanted_.settings = kept;
    changed_ = true;
    return answer;
  }

  static constexpr std::array<std::string_view, @live@> PATHS = {@paths@};
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr tuning_;
  std::mutex mutex_;  // of what is wanted
  std::atomic<bool> changed_{false};
  @name@_controller wanted_;  // of which the settings alone are used
#endif
  @name@_controller controller_;
  @name@_status status_ = @NAME@_OK;
  rclcpp::Time begin_;
  bool begun_ = false;
};

}  // namespace @name@_ros

PLUGINLIB_EXPORT_CLASS(@name@_ros::Controller, controller_interface::ControllerInterface)
