"""`flocc doctor`: says in sentences what is wrong, and what to change."""

from flocc_launch.doctor.diagnose import diagnose, diagnose_loaded
from flocc_launch.doctor.finding import Finding, Severity, finding_lines

__all__ = ["diagnose", "diagnose_loaded", "finding_lines", "Finding", "Severity"]
