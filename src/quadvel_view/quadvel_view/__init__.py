"""Operator interface: a page in the browser, and teleoperation by keyboard and gamepad.

It shows a running robot or a recording. It uses topics and services only, and is independent of
what serves them: simulated robot, real robot or recording.
"""
