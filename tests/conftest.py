"""Types and shapes are checked while the tests run; property tests draw the same examples in CI."""

import os
import signal

from hypothesis import settings

from tests import typecheck

typecheck.install()  # before anything imports the package

# a red run of CI is then of the change, not of the draw; everywhere else every run draws anew
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

# a shell starts jobs in the background with SIGINT ignored, and the programs under test would inherit that
signal.signal(signal.SIGINT, signal.default_int_handler)
