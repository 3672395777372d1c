"""The live page: what a camera sees while someone aims, focuses and lights a rig, in a browser."""
