"""The paper's Fig. 6; torchpose/studies/fig06_regions.py says how.

python scripts/fig06_regions.py --out out/fig06
"""

import sys

from torchpose.studies import fig06_regions
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig06_regions))
