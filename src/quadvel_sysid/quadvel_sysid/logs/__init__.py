"""Measured logs: read from what people have, looked at before anything is fitted."""
