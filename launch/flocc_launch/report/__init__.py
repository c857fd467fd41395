"""What a run came to: report.json, report.html, trajectories and the pose graph."""

from flocc_launch.report.evaluate import evaluate
from flocc_launch.report.finish import finish, read_report
from flocc_launch.report.model import SCHEMA_VERSION, RunReport
from flocc_launch.report.text import sentences

__all__ = ["finish", "evaluate", "sentences", "read_report", "RunReport", "SCHEMA_VERSION"]
