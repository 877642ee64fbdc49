"""Candidates, their screening, and the floating forward search among them."""
