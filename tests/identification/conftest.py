"""The generator and the score are a package under the repository's root, however pytest is called."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
