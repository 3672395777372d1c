"""Test modules import the shared witnesses (tests/exact.py) by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
