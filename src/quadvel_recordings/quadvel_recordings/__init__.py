"""Recordings read without ROS and without a middleware, with `rosbags` alone.

`reading` takes messages out of an MCAP file or a rosbag2, by the definitions that it carries (`recorded`); `definitions` knows the
messages of ROS 2 Jazzy and ours. Not for writing recordings, which is `quadvel_bringup.recorder`'s, nor for what is in them.
"""
