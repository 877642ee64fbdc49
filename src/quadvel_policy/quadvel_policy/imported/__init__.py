"""Policies that other projects trained: their formats, their observations, and how they run here."""
