// SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Declarations of the parts of rclcpp (Jazzy) that examples/motion_tracking_node.cpp uses, to compile it
// where rclcpp is not installed: it has no wheel. Nothing is defined, so nothing can be linked.

#ifndef RCLCPP__RCLCPP_HPP_
#define RCLCPP__RCLCPP_HPP_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>

namespace rclcpp
{

struct QoS
{
  QoS(std::size_t depth);  // NOLINT a number is a history depth
};

template<typename MessageT>
struct Publisher
{
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(const MessageT & message);
};

template<typename MessageT>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
};

class Node
{
public:
  explicit Node(const std::string & name);
  template<typename ParameterT>
  ParameterT declare_parameter(const std::string & name, const ParameterT & value);
  template<typename MessageT>
  typename Publisher<MessageT>::SharedPtr create_publisher(
    const std::string & topic, const QoS & qos);
  template<typename MessageT>
  typename Subscription<MessageT>::SharedPtr create_subscription(
    const std::string & topic, const QoS & qos, std::function<void(const MessageT &)> callback);
};

void init(int argc, char ** argv);
void spin(std::shared_ptr<Node> node);
bool shutdown();

}  // namespace rclcpp

#endif  // RCLCPP__RCLCPP_HPP_
