"""The rig: cameras and robot, capture sessions, and the digital twin that stands in for them."""
