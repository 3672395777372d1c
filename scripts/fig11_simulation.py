"""The paper's Figs. 10 and 11; torchpose/studies/fig11_simulation.py says how.

python scripts/fig11_simulation.py --out out/fig11 --full --blender 29
"""

import sys

from torchpose.studies import fig11_simulation
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(fig11_simulation))
