"""Calibrations of other tools: parsed (`document`), a camera picked (`maps`, `texts`), understood (`fields`)."""
