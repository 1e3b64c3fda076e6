"""Send a depth image to recover_node and read the bodies it answers with (ROS 2, or the extra 'ros').

    ros2 run sq_perception recover_node --ros-args -r depth/image:=/camera/depth -r depth/camera_info:=/camera/info &
    python ros_node.py
"""

import rclpy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import Intrinsics, depth_to_message, intrinsics_to_message
from sq_msgs_py.superquadrics import from_message
from sq_perception.simulation.scenes import sample

rclpy.init()
node = rclpy.create_node("camera")
heard: list[PointCloud2] = []
images = node.create_publisher(Image, "/camera/depth", 1)
infos = node.create_publisher(CameraInfo, "/camera/info", 1)
node.create_subscription(PointCloud2, "/recover_node/superquadrics", heard.append, 10)
frame = sample()
camera = frame.camera
known = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
while rclpy.ok() and not heard:
    header = Header(stamp=node.get_clock().now().to_msg(), frame_id="camera_depth_optical_frame")
    infos.publish(intrinsics_to_message(known, header))
    images.publish(depth_to_message(frame.depth, header))
    rclpy.spin_once(node, timeout_sec=0.5)
bodies = from_message(heard[0]).recovered
for size, place in zip(bodies.size, bodies.translation, strict=True):
    print(f"{2e3 * size[0]:.0f} x {2e3 * size[1]:.0f} x {2e3 * size[2]:.0f} mm at {place.round(2)} m")
node.destroy_node()
rclpy.shutdown()
