"""Put `simulated_joints`, a module in the tests of quadvel_sysid, on the import path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "quadvel_sysid"))
