"""Relative poses from matched local features, whatever found and matched them: two and three views, and a verdict."""
