"""Person following: leg detection in laser scans, tracking, and planning of velocities."""

from .leg_detector import LegDetector
from .person_tracker import PersonTracker, Track, TrackerConfig

__all__ = ["LegDetector", "PersonTracker", "Track", "TrackerConfig"]
