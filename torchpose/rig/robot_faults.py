"""How each fault of a robot is told from what the controller and the child process say."""

from torchpose.rig.child import ChildEnded, ChildError, ChildLate
from torchpose.rig.faults import RobotReason

Cause = tuple[RobotReason, str]  # what is wrong; the fix

QUESTIONS = {
    "model": "get robot model", "serial": "get serial number", "polyscope": "PolyscopeVersion",
    "robot_mode": "robotmode", "safety_status": "safetystatus", "remote": "is in remote control", "running": "running",
}  # fmt: skip

_EMERGENCY: Cause = (RobotReason.EMERGENCY_STOP, "is in emergency stop; release the button and start the robot there")
_PROTECTIVE: Cause = (
    RobotReason.PROTECTIVE_STOP,
    "is in protective stop; see what it touched and unlock it at the pendant",
)
_SAFEGUARD: Cause = (RobotReason.SAFETY_STOP, "is in safeguard stop; close the guard and reset it")
_SAFETY: Cause = (RobotReason.SAFETY_STOP, "is in a safety fault or recovery; see the log at the pendant")
_LOCAL: Cause = (RobotReason.NOT_REMOTE, "is in local control; switch it to remote control at the pendant")
_SAFETY_BITS = {0b1110_0000: _EMERGENCY, 0b100: _PROTECTIVE, 0b1_0000: _SAFEGUARD, 0b111_0000_1000: _SAFETY}
_SAFETY_WORDS = {"EMERGENCY_STOP": _EMERGENCY, "PROTECTIVE_STOP": _PROTECTIVE, "SAFEGUARD_STOP": _SAFEGUARD}


def of_safety_bits(bits: int) -> Cause | None:
    """The cause in the stream's safety_status_bits (RTDE guide), None in normal and reduced mode."""
    return next((cause for mask, cause in _SAFETY_BITS.items() if bits & mask), None)


def of_dashboard(mode: str, safety: str, remote: str, running: str) -> Cause | None:
    """The cause in what the dashboard answers; None where all is well."""
    for word, cause in _SAFETY_WORDS.items():
        if safety.endswith(word):
            return cause
    if safety not in ("NORMAL", "REDUCED"):
        return RobotReason.NOT_READY, f"has the safety status {safety}; see the pendant"
    if mode != "RUNNING":
        return RobotReason.NOT_READY, f"is in the mode {mode}; switch it on and release its brakes"
    if remote == "false":  # controllers before 5.6 cannot say
        return _LOCAL
    if running == "true":
        return RobotReason.NOT_READY, "runs a program already; end it at the pendant"
    return None


def of_child(call: str, error: ChildError, answers: bool) -> Cause:
    """The cause behind the failed request `call` to the child; `answers`: whether the dashboard still does."""
    text, restart = str(error), "restart the session"
    ended = isinstance(error, ChildEnded)
    if call == "upload" and "remote control" in text:
        return _LOCAL
    if call == "upload" and "already in use" in text:
        return (
            RobotReason.REGISTERS_IN_USE,
            "has its input registers in use; switch EtherNet/IP, PROFINET and MODBUS off at the pendant",
        )
    if call == "upload" and not ended:
        return RobotReason.REFUSED_SCRIPT, f"did not start the control script ({text}); see the log at the pendant"
    if error.reason == RobotReason.STALE_STREAM:
        return RobotReason.STALE_STREAM, f"sends no new readings; check the network, {restart}"
    if error.reason == RobotReason.CONNECTION_LOST or (ended and not answers):
        return RobotReason.CONNECTION_LOST, f"has gone from the network; check it, {restart}"
    if isinstance(error, ChildLate):
        return RobotReason.TIMED_OUT, f"{text}; check the controller, {restart}"
    if ended:
        return RobotReason.CHILD_DIED, f"the process that talks to it has ended ({text}); {restart}"
    return RobotReason.CONNECTION_LOST, f"{call} failed ({text}); check the controller, {restart}"
