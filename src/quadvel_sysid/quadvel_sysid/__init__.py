"""System identification of joint actuators from measured logs: diagnosis, model, report."""
