"""ROS 2 nodes: receive, convert, call, convert, publish.  The only part of the package that imports rclpy."""
