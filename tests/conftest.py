"""Test modules import the shared witnesses (tests/exact.py) by name; property tests draw the same examples in CI."""

import os
import signal
import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# a red run of CI is then of the change, not of the draw; everywhere else every run draws anew
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

# a shell starts jobs in the background with SIGINT ignored, and the programs under test would inherit that
signal.signal(signal.SIGINT, signal.default_int_handler)
