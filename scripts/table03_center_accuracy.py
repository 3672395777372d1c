"""The paper's Table III; torchpose/studies/table03_centers.py says how.

python scripts/table03_center_accuracy.py --out out/table03 --seeds 100
"""

import sys

from torchpose.studies import table03_centers
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(table03_centers))
