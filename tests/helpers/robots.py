"""The shipped robots."""

from quadvel_description.robot import load_robot

ALIENGO, GO2 = load_robot("aliengo"), load_robot("go2")
