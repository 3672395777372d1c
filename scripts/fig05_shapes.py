"""The paper's Fig. 5; torchpose/studies/fig05_shapes.py says how.

python scripts/fig05_shapes.py --out out/fig05 --full
"""

import sys

from torchpose.studies import fig05_shapes
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig05_shapes))
