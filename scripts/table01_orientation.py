"""The paper's Table I; torchpose/studies/table01_orientation.py says how.

python scripts/table01_orientation.py --out out/table01 --full
"""

import sys

from torchpose.studies import table01_orientation
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(table01_orientation))
