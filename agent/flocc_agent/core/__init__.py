"""The robot as a pure state machine: events in, effects out, no I/O, no clock, no global random.

Knows numpy, the standard library and the protocol; must not know asyncio, zenoh, OpenCV, torch or GTSAM.
"""
