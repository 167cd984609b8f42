// SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Track one marker: its position with covariance, for a filter such as that of robot_localization.
//
// Build it in a package of your own, with rclcpp, fluoro_calib_msgs and geometry_msgs.

#include <cstddef>
#include <memory>

#include "fluoro_calib_msgs/msg/reconstructed_points.hpp"
#include "geometry_msgs/msg/pose_with_covariance_stamped.hpp"
#include "rclcpp/rclcpp.hpp"

using fluoro_calib_msgs::msg::ReconstructedPoints;
using geometry_msgs::msg::PoseWithCovarianceStamped;

class MotionTracking : public rclcpp::Node
{
public:
  MotionTracking()
  : Node("motion_tracking"), target_(declare_parameter<int64_t>("target", 1001)),
    output_(create_publisher<PoseWithCovarianceStamped>("pose", 100)),
    input_(create_subscription<ReconstructedPoints>(
        "reconstruction/points_with_covariance", 100,
        [this](const ReconstructedPoints & points) {on_points(points);}))
  {
  }

private:
  void on_points(const ReconstructedPoints & points)
  {
    for (std::size_t k = 0; k < points.target_id.size(); ++k) {
      if (points.target_id[k] != target_ || points.status[k] != ReconstructedPoints::OK) {
        continue;  // another target, or one that was not intersected in the calibrated area
      }
      PoseWithCovarianceStamped pose;
      pose.header = points.header;  // its stamp is that of the X-ray exposure
      pose.pose.pose.position.x = points.x[k];
      pose.pose.pose.position.y = points.y[k];
      pose.pose.pose.position.z = points.z[k];
      auto & covariance = pose.pose.covariance;  // 6 x 6, row by row
      covariance[0] = points.cov_xx[k];
      covariance[1] = covariance[6] = points.cov_xy[k];
      covariance[2] = covariance[12] = points.cov_xz[k];
      covariance[7] = points.cov_yy[k];
      covariance[8] = covariance[13] = points.cov_yz[k];
      covariance[14] = points.cov_zz[k];
      output_->publish(pose);
    }
  }

  int64_t target_;
  rclcpp::Publisher<PoseWithCovarianceStamped>::SharedPtr output_;
  rclcpp::Subscription<ReconstructedPoints>::SharedPtr input_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<MotionTracking>());
  rclcpp::shutdown();
  return 0;
}
