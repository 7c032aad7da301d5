"""Golden digests: which there are, and writing them anew (`make golden KIND=svo`)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for helpers
