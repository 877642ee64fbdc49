"""Persons in laser scans: finding their legs, and tracking them."""

from .leg_detector import LegDetector
from .person_tracker import PersonTracker, Track, TrackerConfig

__all__ = ["LegDetector", "PersonTracker", "Track", "TrackerConfig"]
