"""A ROS 2 robot with `rmw_zenoh_cpp` as source and sink, without ROS and without a bridge node (docs/ros2.md).

`names` says how rmw_zenoh names things in zenoh, `types` reads and writes CDR, `incoming` and `outgoing` are the
messages, `static_frames` and `synchroniser` put images, odometry and mounting together, `session` is zenoh, `telling`
publishes corrections, `adapter` is all of it on one event loop.
"""
