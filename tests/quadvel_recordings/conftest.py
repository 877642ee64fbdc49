"""Makes `joint_bags`, which lies beside the tests, importable by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
