"""Eyes and hands of whoever runs the robot: a page in the browser, live and from recordings, and teleoperation.

It knows topics and services alone, and not who serves them: a simulated robot, a real one, or a recording.
"""
