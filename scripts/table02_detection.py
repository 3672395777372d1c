"""The paper's Table II; torchpose/studies/table02_detection.py says how.

python scripts/table02_detection.py --out out/table02 --seeds 20
"""

import sys

from torchpose.studies import table02_detection
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(table02_detection))
