"""What a robot needs before its first run: keys and weights."""
