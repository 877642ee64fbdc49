"""Reading of ROS recordings without ROS and without a middleware, with `rosbags` alone.

`reading` reads messages from MCAP files and rosbag2 folders by the definitions in the file
(`recorded`). `definitions` holds the messages of ROS 2 Jazzy and of quadvel. Recordings are written
by `quadvel_bringup.recorder`.
"""
