"""What a run came to: report.json, report.html, trajectories and the pose graph."""

from flocc_launch.report.finish import finish, read_report
from flocc_launch.report.model import SCHEMA_VERSION, Report
from flocc_launch.report.summary import evaluate, summary

__all__ = ["finish", "evaluate", "summary", "read_report", "Report", "SCHEMA_VERSION"]
