#!/bin/sh
# Makes the environment that tests/sources/test_ros2.py and tests/bridge/test_ros2_rclpy.py run real ROS 2 nodes in:
# rclpy with Fast DDS, from wheels. Nothing of it comes near our own environment. Needs Python 3.11 and the network, once.
set -eu
cache=${SAGS_ROS_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/sags/ros}
[ -x "$cache/bin/python" ] || python3.11 -m venv "$cache"
"$cache/bin/pip" install -q 'ros-rclpy[fastrtps]==9.1.2' 'ros-sensor-msgs==5.5.1' 'ros-geometry-msgs==5.5.1'
