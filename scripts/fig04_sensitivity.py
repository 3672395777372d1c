"""The paper's Fig. 4; torchpose/studies/fig04_sensitivity.py says how.

python scripts/fig04_sensitivity.py --out out/fig04 --full
"""

import sys

from torchpose.studies import fig04_sensitivity
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig04_sensitivity))
