//! Programs without ROS on a ROS 2 network.
