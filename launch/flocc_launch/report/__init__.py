"""What a run came to: report.json, report.html, trajectories and the pose graph."""
