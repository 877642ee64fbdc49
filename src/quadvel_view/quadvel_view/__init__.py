"""Operator interface: a page in the browser, live or from a recording, and teleoperation by keyboard and gamepad.

It uses topics and services only, and is independent of what serves them: simulated robot, real
robot or recording.
"""
