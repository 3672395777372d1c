"""The paper's Fig. 2; torchpose/studies/fig02_pnp.py says how.

python scripts/fig02_pnp_comparison.py --out out/fig02 --full
"""

import sys

from torchpose.studies import fig02_pnp
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig02_pnp))
