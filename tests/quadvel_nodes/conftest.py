"""Message classes for the tests: those of ROS 2 where it is there, else the embedded ones."""

import quadvel_dds

quadvel_dds.install()
