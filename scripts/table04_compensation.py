"""The paper's Table IV and Fig. 9; torchpose/studies/table04_compensation.py says how.

python scripts/table04_compensation.py --out out/table04 --seeds 50
"""

import sys

from torchpose.studies import table04_compensation
from torchpose.studies.script import main

if __name__ == "__main__":
    sys.exit(main(table04_compensation))
