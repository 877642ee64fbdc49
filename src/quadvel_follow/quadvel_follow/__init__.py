"""Persons in laser scans: finding their legs, tracking them, and simulated scans to try it on."""

from .leg_detector import LegDetector
from .person_tracker import PersonTracker, Track, TrackerConfig

__all__ = ["LegDetector", "PersonTracker", "Track", "TrackerConfig"]
