"""The digital twin of a UR controller: starts its process, makes faults in it, asks it for the truth.

By hand: ``python -m torchpose.rig.twin.controller --host 127.0.0.2``; ur-rtde's clients then connect to that host.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from torchpose.errors import ConfigError
from torchpose.rig.child import Child, ChildEnded, ChildError
from torchpose.rig.twin.machine import Fault

__all__ = ["START_POSE", "Fault", "TwinController", "TwinErrors"]

START_POSE = (400.0, 0.0, 300.0, 3.141592653589793, 0.0, 0.0)  # mm, rad: in front of the base, tool downwards
_START_S = 20.0  # a loaded machine may take long to start Python
_ANSWER_S = 5.0

_Deviation = Annotated[FiniteFloat, Field(ge=0, le=1000)]  # mm or degrees (convention)


class TwinErrors(BaseModel):
    """How the simulated robot deviates from an ideal one; part of a twin file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    repeatability_mm: _Deviation = 0.0  # standard deviation by axis of the true pose about the reported one, drawn
    repeatability_deg: _Deviation = 0.0  # anew for every move
    # how much longer true displacements from the start are than reported ones, relative
    scale: FiniteFloat = Field(default=0.0, ge=-0.5, le=0.5)
    reading_noise_mm: _Deviation = 0.0  # standard deviation by axis of every reported position


class TwinController:
    """A running twin, for use in a ``with`` block.

    Args:
        host: loopback address; its ports 30003, 30004 and 29999 must be free.
        faults: present from the start.
        start_pose: tool in the base, mm and rotation vector in rad.
        errors: of the robot.
        seed: of their random numbers.

    Raises:
        ConfigError: the address or one of its ports cannot be used.
    """

    def __init__(
        self,
        host: str = "127.0.0.2",
        faults: Sequence[Fault | str] = (),
        start_pose: Sequence[float] = START_POSE,
        errors: TwinErrors | None = None,
        seed: int = 0,
    ) -> None:
        self.host = host
        self._child = Child("torchpose.rig.twin.server")
        present, errors = [Fault(fault) for fault in faults], errors or TwinErrors()
        setup = {"start_pose": list(start_pose), "errors": errors.model_dump(), "seed": seed, "faults": present}
        try:
            self._child.call("start", _START_S, host=host, **setup)
        except ChildError as error:
            self.close()
            fix = "end the other twin or give another 127.0.0.x"
            raise ConfigError(f"{host}: twin: cannot serve there ({error}); {fix}") from None

    def __enter__(self) -> TwinController:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def inject(self, fault: Fault | str, at_fraction: float | None = None) -> None:
        """Makes a fault, now or at a share (0 to 1) of the path of the present or the next move."""
        try:
            self._child.call("inject", _ANSWER_S, fault=Fault(fault), at_fraction=at_fraction)
        except ChildEnded:
            if fault != Fault.KILL:
                raise

    def clear(self) -> None:
        """Normal operation again, as after a person has cleared the fault at the pendant; no program runs."""
        self._child.call("clear", _ANSWER_S)

    def state(self) -> dict[str, Any]:
        """Where it stands and what has happened.

        Keys: pose and true_pose (mm, rad), moving, fraction (of the path), program (running), safety, faults, moves
        (how many were begun), unlocks (how often somebody unlocked a protective stop).
        """
        return dict(self._child.call("state", _ANSWER_S))

    def true_pose(self) -> tuple[float, ...]:
        """Where the tool really is in the base now: mm and rotation vector in rad."""
        return tuple(self.state()["true_pose"])

    def close(self) -> None:
        """Ends its process."""
        self._child.close(_ANSWER_S)


def main() -> None:
    """Runs a twin until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m torchpose.rig.twin.controller", description=main.__doc__)
    parser.add_argument("--host", default="127.0.0.2", help="loopback address to serve on")
    parser.add_argument("--start-pose", type=float, nargs=6, default=START_POSE, help="x y z in mm, rx ry rz in rad")
    arguments = parser.parse_args()
    try:
        with TwinController(arguments.host, start_pose=arguments.start_pose) as twin:
            print(f"a UR controller's twin answers at {twin.host}; Ctrl-C ends it", flush=True)
            threading.Event().wait()
    except KeyboardInterrupt:
        return
    except ConfigError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
