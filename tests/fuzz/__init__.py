"""A fuzzer of every reader, of what is done with the files they accept, and of every command.

`python -m tests.fuzz --seconds 60` runs it; `tests/fuzz/__main__.py` has the other options.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for helpers
