"""Tasks for the workers' tests; a worker process imports this module."""

import math
import os
import time


def add(one: int, other: int) -> int:
    """Add."""
    return one + other


def fail(text: str) -> None:
    """Raise."""
    raise ValueError(text)


def process_id() -> int:
    """Tell in which process this runs."""
    return os.getpid()


def print_and_echo(value: bytes) -> bytes:
    """Print like a chatty library, then give the argument back."""
    os.write(1, b"chatter\n")
    return value


def die() -> None:
    """End the process without a word."""
    os._exit(7)


def spin(seconds: float) -> int:
    """Be busy in plain Python."""
    end_s, rounds = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        rounds += 1
    return rounds


def hold_the_lock(seconds: float) -> int:
    """Be busy without ever releasing the interpreter lock for long, as GTSAM is."""
    end_s, rounds = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        math.factorial(200_000)
        rounds += 1
    return rounds


def wait_for_ever() -> None:
    """Hang."""
    time.sleep(3600.0)


def first_after(data: bytes, seconds: float) -> int:
    """Give the first byte, later."""
    time.sleep(seconds)
    return data[0]
