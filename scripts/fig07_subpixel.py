"""The paper's Figs. 7 and 8; torchpose/studies/fig07_subpixel.py says how.

python scripts/fig07_subpixel.py --out out/fig07
"""

import sys

from torchpose.studies import fig07_subpixel
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig07_subpixel))
