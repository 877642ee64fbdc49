"""Readers of measured logs: recordings, and tables of all formats."""
