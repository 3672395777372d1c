"""Captures a plan with the robot and the cameras of a rig: the command ``torchpose capture`` from a checkout.

python scripts/capture.py configs/rig/paper_plan.yaml --rig configs/rig/ur5_20mp.yaml --out run
"""

import sys

from torchpose.cli.main import main

if __name__ == "__main__":
    main(["capture", *sys.argv[1:]])
