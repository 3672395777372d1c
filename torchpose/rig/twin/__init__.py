"""The digital twin: a robot controller that speaks the real wire protocol, and the frames that its camera would see."""
