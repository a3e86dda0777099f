"""Joins ROS 2 without ROS: messages, keys and bags for the legs of a robot.

Pure of any network: :mod:`adaptive_contact.service.ros2` sends and receives, and
:mod:`adaptive_contact.service.recording` reads bags.  Only :mod:`adaptive_contact.ros2.types` needs
the extra ``ros2`` (rosbags).
"""
